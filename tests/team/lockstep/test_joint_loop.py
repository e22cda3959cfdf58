"""JointLoop: what the models learn from, determinism, random number generators, and the order of callbacks."""

import random
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch as th
from mpe2 import simple_spread_v3
from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.callbacks import MaskableEvalCallback
from stable_baselines3 import A2C, DQN, PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_belief import MaskableBeliefPPO
from sb3_belief.team.agent_models import agent_seed, env_seed
from sb3_belief.zoo.evaluate import evaluate
from tests.team.helpers import PPO_KWARGS, Record, Team, make_team_env, parameters
from tests.team.toy_envs import MaskedEnv, MixedEnv, ScriptedEnv, ToyEnv, ToySolo


def learned(vec_env="dummy", seed=3):
    """Return the parameters of three PPO agents after 64 timesteps of ``simple_spread``."""
    env = make_team_env(simple_spread_v3.parallel_env, n_envs=2, vec_env=vec_env, env_kwargs={"max_cycles": 5})
    team = Team(PPO, "MlpPolicy", env, seed=seed, **PPO_KWARGS)
    team.learn(64)
    env.close()
    return [parameters(model) for model in team.agents.values()]


def test_three_ppos_on_simple_spread_are_deterministic_and_equal_with_workers():
    first, again, workers, other_seed = learned(), learned(), learned("subproc"), learned(seed=4)
    assert all(th.equal(a, b) for a, b in zip(first, again, strict=True))
    assert all(th.equal(a, b) for a, b in zip(first, workers, strict=True))
    assert not th.equal(first[0], other_seed[0])
    assert not th.equal(first[0], first[1])


@pytest.mark.parametrize("algo, kwargs", [(PPO, PPO_KWARGS), (A2C, {"n_steps": 4}), (DQN, {"learning_starts": 10})])
def test_an_agent_learns_what_it_would_learn_alone(algo, kwargs):
    """Its parameters are the same to the bit, whatever algorithm its teammate runs and however many numbers that draws."""
    seed, runs = 11, []
    for teammate, own in ((PPO, PPO_KWARGS), (A2C, {"n_steps": 3}), (DQN, {"learning_starts": 6})):
        env = make_team_env(ToyEnv, n_envs=2)
        classes, own_kwargs = {"agent_0": teammate, "agent_1": algo}, {"agent_0": own, "agent_1": kwargs}
        team = Team(classes, "MlpPolicy", env, seed=seed, agent_kwargs=own_kwargs, device="cpu")
        team.learn(80)
        runs.append(parameters(team.agents["agent_1"]))

    alone_env = DummyVecEnv([partial(ToySolo, index=1)] * 2)
    alone = algo("MlpPolicy", alone_env, seed=agent_seed(seed, 1), **{"device": "cpu", **kwargs})
    untrained = parameters(alone)
    alone_env.seed(env_seed(seed))
    alone.learn(80)
    assert not th.equal(untrained, parameters(alone))
    assert all(th.equal(parameters(alone), run) for run in runs)


def test_the_callers_random_numbers_are_left_alone():
    def state():
        return random.getstate(), str(np.random.get_state()), th.get_rng_state().tolist()

    env = make_team_env(ToyEnv)
    np.random.normal()  # NumPy's generator then holds back a second number
    before = state()
    team = Team(PPO, "MlpPolicy", env, seed=0, **PPO_KWARGS)
    assert state() == before
    team.learn(16)
    assert state() == before


def test_random_numbers_continue_over_calls():
    """A second ``learn`` does not repeat the random numbers of the first."""
    env = make_team_env(ToyEnv)
    record = Record(keep=("actions",))
    team = Team(PPO, "MlpPolicy", env, seed=0, **{**PPO_KWARGS, "learning_rate": 0.0, "n_steps": 32})
    draws = []

    class Draw(BaseCallback):
        def _on_step(self):
            draws.append((random.random(), np.random.rand(), th.rand(1).item()))
            return True

    team.learn(32, callback=[record, Draw()], agent_callbacks={"agent_0": Draw()})
    team.learn(32, callback=[record, Draw()], agent_callbacks={"agent_0": Draw()})
    actions = [kept["actions"]["agent_0"][0] for kept in record.kept]
    assert actions[:32] != actions[32:]
    # The team's callback does not repeat the agent's random numbers either
    assert len(set(draws)) == len(draws) == 128


class Buffer(BaseCallback):
    """Callback that copies the rollout as training gets it, with bootstrapped rewards and advantages."""

    model: Any

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        buffer = self.model.rollout_buffer
        self.copies = {
            key: getattr(buffer, key).copy() for key in ("observations", "rewards", "values", "episode_starts", "advantages")
        }
        with th.no_grad():
            self.last_value = self.model.policy.predict_values(th.as_tensor(self.model._last_obs)).item()
            # Values of the observations at time limits, which are never in the buffer
            terminals = {t: np.array([[t, 10]], dtype=np.float32) for t in (6, 8)}
            self.terminal_values = {t: self.model.policy.predict_values(th.as_tensor(o)).item() for t, o in terminals.items()}


@pytest.mark.parametrize(
    "agent, ends",
    [
        # The step after which an agent's return ends, and whether a limit cut it off, so that the value is bootstrapped
        ("stays", {3: False, 8: True}),
        ("dies", {5: False, 8: False}),
        ("cut", {6: True, 8: False}),
        ("last", {8: True}),
    ],
)
def test_time_limits_bootstrap_and_life_ends_do_not(agent, ends):
    gamma, lam, n_steps = 0.9, 0.8, 12
    env = make_team_env(ScriptedEnv)
    team = Team(PPO, "MlpPolicy", env, seed=0, **{**PPO_KWARGS, "n_steps": n_steps, "gamma": gamma, "gae_lambda": lam})
    buffer = Buffer()
    team.learn(n_steps, agent_callbacks={agent: buffer})

    rewards = [1 + 10 * env.possible_agents.index(agent) + (t % 8 + 1) / 100 for t in range(n_steps)]
    values = buffer.copies["values"][:, 0]
    # Steps count from 1. The 12 steps are an episode of 8 and half of the next, in which the same happens at the same steps
    ends = ends | {t + 8: cut for t, cut in ends.items() if t + 8 < n_steps}
    expected = np.zeros(n_steps)
    for t in range(n_steps):
        # By definition, the advantage is the sum of discounted TD errors until the return ends
        weight = 1.0
        for k in range(t, n_steps):
            step = k + 1
            if step in ends:
                following = buffer.terminal_values[step] if ends[step] else 0.0
            else:
                following = values[k + 1] if step < n_steps else buffer.last_value
            expected[t] += weight * (rewards[k] + gamma * following - values[k])
            weight *= gamma * lam
            if step in ends:
                break
    assert buffer.copies["advantages"][:, 0] == pytest.approx(expected, abs=1e-4)
    assert buffer.copies["episode_starts"][:, 0].tolist() == [float(t == 0 or t in ends) for t in range(n_steps)]


def test_order_of_callbacks_and_counts():
    env = make_team_env(ToyEnv, n_envs=2)
    team = Team(PPO, "MlpPolicy", env, seed=0, **PPO_KWARGS)
    seen = []

    class Counts(BaseCallback):
        def _on_step(self):
            assert self.training_env is env and id(self.model) == id(team)
            counts = {model.num_timesteps for model in team.agents.values()}
            in_buffer = {model.rollout_buffer.pos for model in team.agents.values()}
            seen.append((self.num_timesteps, counts, in_buffer, self.locals["rewards"].shape))
            return True

    record, own = Record(), Record()
    team.learn(32, callback=[Counts(), record], agent_callbacks={"agent_1": own})
    # SB3 runs callbacks when a step has been counted but not yet added to the buffer
    assert seen == [(2 * t, {2 * t}, {(t - 1) % 8}, (2,)) for t in range(1, 17)]
    rollout = ["rollout start", *["step"] * 8, "rollout end"]
    assert record.events == ["training start", *rollout, *rollout, "training end"]
    assert own.events == record.events and own.model is team.agents["agent_1"]
    assert team.num_timesteps == 32


@pytest.mark.parametrize("algo, kwargs", [(PPO, PPO_KWARGS), (DQN, {"learning_starts": 10})])
def test_callbacks_do_not_change_what_is_learned(algo, kwargs):
    """Without callbacks a step takes a shorter path through the code, with the same results."""
    runs = []
    for team_callback, own in ((None, {}), (Record(), {}), (None, {"agent_1": Record()}), (Record(), {"agent_0": Record()})):
        team = Team(algo, "MlpPolicy", make_team_env(ToyEnv, n_envs=2), seed=0, **kwargs)
        team.learn(48, callback=team_callback, agent_callbacks=own)
        assert team.num_timesteps == 48
        runs.append([parameters(model) for model in team.agents.values()])
    assert all(th.equal(a, b) for run in runs[1:] for a, b in zip(run, runs[0], strict=True))


def test_unequal_rollouts():
    """An agent that has finished learning keeps acting, without learning, until the last one has finished."""
    env = make_team_env(ToyEnv)
    own_kwargs = {"agent_0": {"n_steps": 8}, "agent_1": {"n_steps": 20}}
    team = Team(PPO, "MlpPolicy", env, seed=0, agent_kwargs=own_kwargs, **{**PPO_KWARGS, "batch_size": 4})
    short, long, record = Record(), Record(), Record(keep=("actions",))
    after = {}

    class Snapshot(BaseCallback):
        def _on_training_end(self):
            after["agent_0"] = parameters(self.model)

        def _on_step(self):
            return True

    team.learn(30, callback=record, agent_callbacks={"agent_0": [short, Snapshot()], "agent_1": long})
    assert short.steps == 32 and long.steps == 40 and record.steps == 40
    assert {agent: model.num_timesteps for agent, model in team.agents.items()} == {"agent_0": 32, "agent_1": 40}
    assert team.num_timesteps == 40
    assert th.equal(after["agent_0"], parameters(team.agents["agent_0"]))
    late = [int(kept["actions"]["agent_0"][0]) for kept in record.kept[32:]]
    assert len(set(late)) > 1
    # agent_0 has not learned from the last steps, so further learning begins with new episodes for all agents
    again = Record(keep=("dones",))
    team.learn(20, reset_num_timesteps=False, callback=again)
    assert [int(kept["dones"][0]) for kept in again.kept[:14]] == ([0] * 6 + [1]) * 2
    # The team's rollout ends with the longest rollout of an agent
    assert [record.events[:i].count("step") for i, event in enumerate(record.events) if event == "rollout end"] == [20, 40]


def test_continue_where_it_was():
    """
    Two calls, the second with ``reset_num_timesteps=False``, equal one call.

    The exception is what SB3 itself resets between calls, which is nothing here.
    """
    runs = []
    for parts in ([48], [16, 32]):
        team = Team(PPO, "MlpPolicy", make_team_env(ToyEnv, n_envs=2), seed=0, **PPO_KWARGS)
        for i, part in enumerate(parts):
            team.learn(part, reset_num_timesteps=i == 0)
        assert team.num_timesteps == 48 and team.agents["agent_1"].num_timesteps == 48
        runs.append([parameters(model) for model in team.agents.values()])
    assert all(th.equal(a, b) for a, b in zip(*runs, strict=True))
    team.learn(16)
    assert team.num_timesteps == 16


def test_every_kind_of_space_and_algorithm_at_once():
    from sb3_contrib import TRPO, RecurrentPPO

    env = make_team_env(MixedEnv, n_envs=2)
    classes = {"zeta": DQN, "box": SAC, "multi": RecurrentPPO, "binary": TRPO}
    policies = {"zeta": "MlpPolicy", "box": "MlpPolicy", "multi": "MlpLstmPolicy", "binary": "MlpPolicy"}
    own_kwargs = {
        "zeta": {"learning_starts": 4, "train_freq": 3},
        "box": {"learning_starts": 4, "batch_size": 4, "policy_kwargs": {"net_arch": [8]}},
        "multi": {"n_steps": 5, "batch_size": 5, "n_epochs": 1},
        "binary": {"n_steps": 7, "batch_size": 7},
    }
    team = Team(classes, policies, env, seed=0, agent_kwargs=own_kwargs, device="cpu")
    before = {agent: parameters(model) for agent, model in team.agents.items()}
    team.learn(60)
    assert [type(model) for model in team.agents.values()] == list(classes.values())
    assert all(not th.equal(before[agent], parameters(model)) for agent, model in team.agents.items())
    obs = env.reset()
    actions, state = team.predict(obs, deterministic=True)
    env.step(actions)
    assert state["zeta"] is None and len(state["multi"]) == 2
    _, state2 = team.predict(obs, state, episode_start=np.zeros(2, bool), deterministic=True)
    assert not np.array_equal(state["multi"][0], state2["multi"][0])
    # A row of a replay buffer is a joint step
    buffer = team.agents["zeta"].replay_buffer
    assert buffer.pos == 30 and buffer.dones[:5, 0].tolist() == [0, 0, 0, 0, 1]


def test_dying_agents_learn_on():
    team = Team(PPO, "MlpPolicy", make_team_env(ScriptedEnv), seed=0, **PPO_KWARGS)
    record = Record(keep=("new_obs", "dones", "infos"))
    team.learn(16, agent_callbacks={"dies": record})
    assert [bool(kept["dones"][0]) for kept in record.kept] == [t in (5, 8, 13, 16) for t in range(1, 17)]
    assert [kept["infos"][0]["active"] for kept in record.kept[:8]] == [True] * 5 + [False] * 3
    assert [kept["new_obs"][0, 0] for kept in record.kept[:8]] == [1, 2, 3, 4, 0, 0, 0, 0]
    assert [len(kept["infos"][0]["others_actions"]) for kept in record.kept[:1]] == [6]


@pytest.mark.parametrize("algorithm, policy", [(MaskablePPO, "MlpPolicy"), (MaskableBeliefPPO, "BeliefPolicy")])
def test_masks_reach_rollout_and_evaluation(algorithm, policy):
    make_env = partial(MaskedEnv, n_agents=3, limit=4)
    env, eval_env = make_team_env(make_env, n_envs=2), make_team_env(make_env, n_envs=3)
    # MaskedEnv raises if an action is masked out. agent_0 finishes first and keeps acting without learning
    own_kwargs = {"agent_0": {"n_steps": 6, "batch_size": 4}}
    team = Team(algorithm, policy, env, seed=0, agent_kwargs=own_kwargs, **PPO_KWARGS)
    assert team.takes_masks
    callback = MaskableEvalCallback(eval_env, n_eval_episodes=6, eval_freq=8, verbose=0)
    team.learn(30, callback=callback)
    assert callback.n_calls > 8 and np.isfinite(callback.last_mean_reward)
    assert [model.num_timesteps for model in team.agents.values()] == [36, 32, 32]
    actions, _ = team.predict(env.reset(), action_masks=env.action_masks())
    env.step(actions)
    assert len(evaluate(team, eval_env, 6).returns) == 6
    plain = Team(algorithm, policy, make_team_env(ToyEnv), seed=0, **PPO_KWARGS)
    assert not Team(PPO, "MlpPolicy", env, seed=0, **PPO_KWARGS).takes_masks
    with pytest.raises(ValueError, match="does not support action masking"):
        plain.learn(8)
