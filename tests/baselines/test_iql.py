"""IQL: its target, masks, coins, ends and inactive steps, its likeness to SB3's DQN, and its life in a team."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib.common.maskable.evaluation import evaluate_policy
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.logger import configure

from sb3_belief.baselines import IQL
from tests.baselines.helpers import Q_KWARGS, targets_of
from tests.team.helpers import Team, make_team_env, parameters
from tests.team.toy_envs import MaskedEnv, ScriptedEnv, ToyEnv

GAMMA = 0.99


class Choices(ToyEnv):
    """A ``ToyEnv`` whose masks are random: each action is possible with the probability one half, and one always is."""

    def infos(self):
        masks = {}
        for i, agent in enumerate(self.agents):
            mask = np.random.default_rng([self.t, i]).random(3) < 0.5
            mask[(self.t + i) % 3] = True
            masks[agent] = {"action_mask": mask}
        return masks

    def step(self, actions):
        for agent, info in self.infos().items():
            assert info["action_mask"][actions[agent]], f"{agent} did {actions[agent]} at step {self.t}"
        return super().step(actions)


class Dying(ToyEnv):
    """A ``ToyEnv`` whose first agent is dead after step 3: its return runs on, and only action 0 is possible for it."""

    def infos(self):
        infos: dict[str, dict[str, Any]] = {agent: {"action_mask": np.ones(3, dtype=bool)} for agent in self.agents}
        if self.t >= 3:
            infos["agent_0"]["action_mask"] = np.arange(3) == 0
            infos["agent_0"]["next_active"] = False
        if self.t > 3:
            infos["agent_0"]["active"] = False
        return infos


def played(env, n_steps=40, agent="agent_0", **kwargs) -> Any:
    """Return an agent's model after some steps of play without an update."""
    team = Team(IQL, "MlpPolicy", env, seed=0, **{**Q_KWARGS, "learning_starts": 10**6, **kwargs}).learn(n_steps)
    model = team.agents[agent]
    model.set_logger(configure(None, []))
    return model


# Its likeness to DQN


@pytest.mark.parametrize(("n_envs", "normalize"), [(1, False), (3, False), (1, True)])
def test_without_masks_and_double_q_it_is_dqn_weight_for_weight(n_envs, normalize, monkeypatch):
    kwargs = {**Q_KWARGS, "seed": 0, "normalize": normalize}
    if n_envs > 1:
        # One coin for all copies and one for each take a different number of random numbers: none is tossed
        monkeypatch.setattr(np.random, "rand", lambda *shape: np.ones(shape))
    learned = []
    for algorithm, own in ((DQN, {}), (IQL, {"double_q": False}), (IQL, {})):
        team = Team(algorithm, "MlpPolicy", make_team_env(ToyEnv, n_envs=n_envs, seed=0), **{**kwargs, **own}).learn(300)
        learned.append([parameters(model) for model in team.agents.values()])
    dqn, iql, double = learned
    assert all(th.equal(a, b) for a, b in zip(dqn, iql, strict=True))
    assert n_envs > 1 or not any(th.equal(a, b) for a, b in zip(dqn, double, strict=True))


def test_alone_in_a_gymnasium_environment_it_is_dqn():
    kwargs = {**Q_KWARGS, "seed": 0}
    dqn = DQN("MlpPolicy", gym.make("CartPole-v1"), **kwargs).learn(400)
    iql = IQL("MlpPolicy", gym.make("CartPole-v1"), double_q=False, **kwargs).learn(400)
    assert th.equal(parameters(dqn), parameters(iql))


# The target


def test_the_target_is_that_of_double_q_learning_over_possible_actions():
    model = played(make_team_env(Choices, n_envs=2, seed=0))
    with th.no_grad():
        # Online and target network choose different actions
        for weight in model.q_net_target.parameters():
            weight.add_(th.randn(weight.shape, generator=th.Generator().manual_seed(0)))
    buffer = model.replay_buffer
    found, single = targets_of(model), None
    differs = 0
    for row in range(buffer.size()):
        for copy in range(2):
            next_obs = th.as_tensor(buffer.next_observations[row, copy][None])
            with th.no_grad():
                online, target = model.q_net(next_obs)[0].numpy(), model.q_net_target.target(next_obs)[0].numpy()
            mask = buffer.next_masks[row, copy]
            best = np.flatnonzero(mask)[online[mask].argmax()]
            ended = buffer.dones[row, copy] and not buffer.timeouts[row, copy]
            expected = buffer.rewards[row, copy] + GAMMA * (not ended) * target[best]
            assert found[row, copy] == pytest.approx(expected, abs=1e-5)
            differs += best != np.flatnonzero(mask)[target[mask].argmax()]
    assert differs
    model.q_net_target.double_q = False
    single = targets_of(model)
    assert (single >= found - 1e-6).all() and (single > found + 1e-3).any()


@pytest.mark.parametrize("double_q", [True, False])
def test_only_the_right_targets_move(double_q):
    model = played(make_team_env(Choices, n_envs=2, seed=0), double_q=double_q)
    buffer = model.replay_buffer
    before = targets_of(model)

    def moved():
        return {(int(row), int(copy)) for row, copy in np.argwhere(~np.isclose(targets_of(model), before, atol=1e-6))}

    row, cut = 2, 6
    assert buffer.timeouts[cut].all() and not buffer.dones[row].any()
    # The end of a return: nothing but the reward is left
    buffer.dones[row, 1] = True
    assert moved() == {(row, 1)} and targets_of(model)[row, 1] == pytest.approx(buffer.rewards[row, 1])
    buffer.dones[row, 1] = False
    # A truncation that is an end
    buffer.timeouts[cut, 0] = False
    assert moved() == {(cut, 0)} and targets_of(model)[cut, 0] == pytest.approx(buffer.rewards[cut, 0])
    buffer.timeouts[cut, 0] = True
    # A reward
    buffer.rewards[row, 0] += 1
    assert moved() == {(row, 0)}
    buffer.rewards[row, 0] -= 1
    assert moved() == set()
    # The value of an action: only where it is possible
    with th.no_grad():
        for net in (model.q_net, model.q_net_target.target):
            net.q_net[-1].bias[1] += 100
    assert moved() == {(int(row), int(copy)) for row, copy in np.argwhere(buffer.next_masks[: buffer.size(), :, 1])}


def test_ties_go_to_the_lowest_possible_index():
    model = played(make_team_env(Choices, n_envs=2, seed=0), exploration_initial_eps=0.0)
    with th.no_grad():
        for weight in model.policy.parameters():
            weight.zero_()
    obs = np.zeros((3, 2), dtype=np.float32)
    masks = np.array([[1, 1, 1], [0, 1, 1], [0, 0, 1]], dtype=bool)
    assert model.predict(obs, deterministic=True, action_masks=masks)[0].tolist() == [0, 1, 2]
    assert model.predict(obs[0], deterministic=True, action_masks=masks[1])[0].shape == ()
    assert model.predict(obs, deterministic=True)[0].tolist() == [0, 0, 0]


# Acting


@pytest.mark.parametrize("env", [Choices, MaskedEnv])
@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_no_impossible_action_is_chosen(env, vec_env, recwarn):
    # The environments raise at the first one, in the warm-up, in exploration and in evaluation
    joint = make_team_env(env, n_envs=2, seed=0, vec_env=vec_env)
    team = Team(IQL, "MlpPolicy", joint, seed=0, **Q_KWARGS).learn(200)
    assert np.isfinite(evaluate_policy(team, make_team_env(env, n_envs=2, seed=1), n_eval_episodes=4, warn=False)[0])
    assert not any("not heeded" in str(warning.message) for warning in recwarn)
    joint.close()


# Ends, and steps out of play


def test_every_end_and_what_lies_between_lives():
    env = make_team_env(ScriptedEnv, n_envs=1, seed=0)
    team = Team(IQL, "MlpPolicy", env, seed=0, **{**Q_KWARGS, "learning_starts": 10**6}).learn(16)
    ends = {}
    for agent, model in team.agents.items():
        buffer = model.replay_buffer
        ends[agent] = [
            "-" if not learnable else "cut" if timeout else "end" if done else ""
            for done, timeout, learnable in zip(
                buffer.dones[:16, 0], buffer.timeouts[:16, 0], buffer.learnable[:16, 0], strict=True
            )
        ]
    # Between the end of its life at step 3 and the next one "stays" does not learn; who has left does not either
    assert ends == {
        "stays": ["", "", "end", "-", "-", "", "", "cut"] * 2,
        "dies": ["", "", "", "", "end", "-", "-", "-"] * 2,
        "cut": ["", "", "", "", "", "cut", "-", "-"] * 2,
        "last": ["", "", "", "", "", "", "", "cut"] * 2,
    }
    buffer = team.agents["cut"].replay_buffer
    assert buffer.next_observations[5, 0].tolist() == [6, 10] and buffer.next_observations[13, 0].tolist() == [6, 20]


def test_the_dead_learn_while_their_return_runs_on_and_a_limit_cuts_it_off():
    model = played(make_team_env(Dying, n_envs=1, seed=0), 14)
    buffer = model.replay_buffer
    assert buffer.learnable[:14].all()
    assert buffer.dones[:14, 0].tolist() == buffer.timeouts[:14, 0].tolist() == ([0] * 6 + [1]) * 2
    # From step 3 on the next action is the only one of the dead, also at the limit
    assert buffer.next_masks[:7, 0, 1].tolist() == [True, True, False, False, False, False, False]
    assert (buffer.actions[4:7, 0, 0] == 0).all()


def test_steps_before_the_first_life_are_not_learned_from():
    class Joins(ToyEnv):
        """The first agent joins at step 3."""

        def infos(self):
            return {agent: {"active": agent != "agent_0" or self.t > 3, "next_active": self.t >= 3} for agent in self.agents}

    buffer = played(make_team_env(Joins, n_envs=2, seed=0), 28).replay_buffer
    assert buffer.learnable[:14, 0].tolist() == buffer.learnable[:14, 1].tolist() == ([False] * 3 + [True] * 4) * 2


def test_masks_at_a_limit_are_those_of_the_old_episode():
    model = played(make_team_env(MaskedEnv, n_envs=2, seed=0), 14)
    masks = model.replay_buffer.next_masks
    # Step 7 of the old episode, action 7 % 3; the next one begins with action 0
    assert masks[6].tolist() == [[False, True, False]] * 2 and masks[5].tolist() == [[True, False, False]] * 2


def test_who_is_cut_off_before_the_others_has_its_own_last_mask():
    class Leaves(ToyEnv):
        """The first agent is cut off at step 4 and leaves; its mask then allows action 2 alone."""

        def infos(self):
            return {agent: {"action_mask": np.arange(3) == 2 if self.t == 4 else np.ones(3, bool)} for agent in self.agents}

        def step(self, actions):
            obs, rewards, ends, cuts, infos = super().step(actions)
            if self.t == 4:
                cuts["agent_0"] = True
                self.agents = ["agent_1"]
            return obs, rewards, ends, cuts, infos

    buffer = played(make_team_env(Leaves, n_envs=1, seed=0), 7).replay_buffer
    assert buffer.timeouts[:7, 0].tolist() == [0, 0, 0, 1, 0, 0, 0]
    assert buffer.next_masks[:4, 0].sum(axis=1).tolist() == [3, 3, 3, 1] and buffer.next_masks[3, 0, 2]
    assert buffer.learnable[:7, 0].tolist() == [True] * 4 + [False] * 3


def test_where_an_environment_does_not_say_its_last_masks_all_actions_count():
    class Alone(gym.Env):
        observation_space, action_space = spaces.Box(-1, 1, (1,)), spaces.Discrete(3)

        def reset(self, *, seed=None, options=None):
            self.t = 0
            return np.zeros(1, np.float32), {}

        def step(self, action):
            assert self.action_masks()[action]
            self.t += 1
            return np.zeros(1, np.float32), 0.0, False, self.t == 4, {}

        def action_masks(self):
            return np.arange(3) == self.t % 3

    model: Any = IQL("MlpPolicy", Alone(), seed=0, **Q_KWARGS).learn(60)
    masks = model.replay_buffer.next_masks[:8, 0].sum(axis=1)
    assert masks.tolist() == [1, 1, 1, 3, 1, 1, 1, 3]


# The replay buffer


def test_only_learnable_rows_are_sampled_and_each_equally_often():
    model = played(make_team_env(ToyEnv, n_envs=3, seed=0), 120)
    buffer = model.replay_buffer
    rng = np.random.default_rng(0)
    buffer.learnable[:] = rng.random(buffer.learnable.shape) < 0.3
    # Each row is known by its reward
    buffer.rewards[:] = np.arange(buffer.rewards.size).reshape(buffer.rewards.shape)
    learnable = np.flatnonzero(buffer.learnable[: buffer.size()])
    np.random.seed(0)
    drawn = buffer.sample(20_000).rewards.numpy().ravel().astype(int)
    counts = np.bincount(drawn, minlength=buffer.rewards.size)
    assert set(np.flatnonzero(counts)) == set(learnable)
    assert counts[learnable] == pytest.approx(np.full(len(learnable), 20_000 / len(learnable)), rel=0.25)


def test_a_buffer_with_nothing_to_learn_says_so():
    model = played(make_team_env(ToyEnv, n_envs=1, seed=0))
    model.replay_buffer.learnable[:] = False
    with pytest.raises(ValueError, match="nothing to learn"):
        model.replay_buffer.sample(4)


def test_dict_observations():
    class Parts(Choices):
        def observation_space(self, agent):
            return spaces.Dict({"a": spaces.Box(-9, 9, (2,), np.float32), "b": spaces.Discrete(8)})

        def observations(self):
            return {agent: {"a": position.astype(np.float32), "b": self.t} for agent, position in self.positions.items()}

    team = Team(IQL, "MultiInputPolicy", make_team_env(Parts, n_envs=2, seed=0), seed=0, **Q_KWARGS).learn(120)
    buffer = team.agents["agent_0"].replay_buffer
    # The last observation of an episode, not the first of the next one
    assert buffer.next_observations["b"][6].ravel().tolist() == [7, 7]
    assert buffer.sample(5).next_observations["a"].shape == (5, 2)


# In a team, saved and loaded


def test_with_others_of_other_kinds_saved_and_loaded(tmp_path):
    env = make_team_env(Choices, n_envs=2, seed=0)
    own = {"agent_0": Q_KWARGS, "agent_1": {"n_steps": 8, "batch_size": 8}}
    with pytest.warns(UserWarning, match="not heeded"):
        # PPO has no masks, so the environment must not raise
        team = Team(
            {"agent_0": IQL, "agent_1": PPO}, "MlpPolicy", make_team_env(ToyMasks, n_envs=2, seed=0), seed=0, agent_kwargs=own
        )
        team.learn(64)
    team = Team(IQL, "MlpPolicy", env, seed=0, double_q=False, **Q_KWARGS).learn(64)
    team.save(tmp_path / "team.zip")
    loaded = Team.load(tmp_path / "team.zip", env=env)
    for agent, model in team.agents.items():
        other = loaded.agents[agent]
        assert th.equal(parameters(model), parameters(other))
        assert other.double_q is False and other.q_net_target.double_q is False
        assert other.q_net_target._online == (other.policy.q_net,)
    loaded.learn(32)


class ToyMasks(ToyEnv):
    """A ``ToyEnv`` that says masks and ignores them."""

    def infos(self):
        return {agent: {"action_mask": np.arange(3) != self.t % 3} for agent in self.agents}


def test_an_agent_is_saved_and_loaded_alone_with_its_buffer(tmp_path):
    model = played(make_team_env(Choices, n_envs=2, seed=0), 60)
    model.save(tmp_path / "agent.zip")
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    loaded: Any = IQL.load(tmp_path / "agent.zip")
    assert th.equal(parameters(model), parameters(loaded))
    obs = np.random.default_rng(0).normal(size=(20, 2)).astype(np.float32)
    masks = np.random.default_rng(0).random((20, 3)) < 0.6
    masks[:, 0] = True
    for action_masks in (None, masks):
        actions = [each.predict(obs, deterministic=True, action_masks=action_masks)[0] for each in (model, loaded)]
        assert np.array_equal(*actions)
    loaded.load_replay_buffer(tmp_path / "buffer.pkl")
    for name in ("observations", "next_masks", "learnable", "timeouts"):
        assert np.array_equal(getattr(model.replay_buffer, name), getattr(loaded.replay_buffer, name))
    loaded.set_logger(configure(None, []))
    assert np.array_equal(targets_of(model), targets_of(loaded), equal_nan=True)


def test_a_team_warns_of_missing_masks_where_it_has_learned_with_some(recwarn):
    obs = {agent: np.zeros((1, 2), dtype=np.float32) for agent in ("agent_0", "agent_1")}
    for env, warned in ((ToyEnv, 0), (Choices, 1)):
        team = Team(IQL, "MlpPolicy", make_team_env(env, n_envs=1, seed=0), seed=0, **Q_KWARGS).learn(20)
        team.predict(obs)
        assert sum("predicts without any" in str(warning.message) for warning in recwarn) == warned


def test_box_actions_are_refused():
    with pytest.raises(AssertionError, match="Discrete"):
        IQL("MlpPolicy", gym.make("Pendulum-v1"))
