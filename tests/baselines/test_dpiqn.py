"""DPIQN and DRPIQN: the loss with its adaptive weight, what is predicted of whom, the window, and their life in a team."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.logger import configure
from torch.nn import functional

from sb3_belief.baselines import DPIQN, DRPIQN, IQL
from sb3_belief.baselines.others_replay import OthersMinibatch
from sb3_belief.belief_ppo.buffers import attach, attached
from tests.baselines.helpers import Q_KWARGS, targets_of
from tests.baselines.test_iql import Choices
from tests.team.helpers import Team, make_team_env, parameters
from tests.team.toy_envs import MixedEnv, ScriptedEnv, ToyEnv

BOTH = pytest.mark.parametrize("algorithm", [DPIQN, DRPIQN])


class FourActions(ToyEnv):
    """A ``ToyEnv`` whose agents have four actions."""

    def action_space(self, agent):
        return spaces.Discrete(4)


def window(algorithm):
    return {"observe_window": 4} if algorithm is DRPIQN else {}


def played(algorithm=DPIQN, env: Any = ToyEnv, n_steps=40, env_kwargs=None, **kwargs) -> Any:
    """Return the first agent's model after some steps of play without an update."""
    joint = make_team_env(env, n_envs=2, seed=0, env_kwargs=env_kwargs, **window(algorithm))
    team = Team(algorithm, "MlpPolicy", joint, seed=0, **{**Q_KWARGS, "learning_starts": 10**6, **kwargs}).learn(n_steps)
    model = team.agents[joint.possible_agents[0]]
    model.set_logger(configure(None, []))
    return model


# The loss


def test_the_numbers_of_the_loss_and_its_gradient():
    """L_Q = .5 and L_PI = ln 4 give lambda = .8493 and L = 1.8110; the gradient is that of the explicit sum."""
    model = played(env=FourActions)
    network = model.q_net
    with th.no_grad():
        # Uniform predictions of one other with four actions
        network.others.weight.zero_()
        network.others.bias.zero_()
    samples = model.replay_buffer.sample(8)
    values = network(samples.observations)
    # Each error is 1, where the Huber loss is .5
    taken = values.gather(1, samples.actions.long())
    q_loss = functional.smooth_l1_loss(taken, taken.detach() - 1)
    ((pi_loss, weight),) = network.recorded[-1:]
    assert (float(q_loss), pi_loss, weight) == pytest.approx((0.5, np.log(4), 0.8493), abs=1e-4)
    assert weight * float(q_loss) + pi_loss == pytest.approx(1.8110, abs=1e-4)

    parts = list(network.parameters())
    found = th.autograd.grad(q_loss, parts)
    plain = th.as_tensor(samples.observations).detach()
    values, others = network(plain), attached(samples.observations)
    loss = network.inference_loss(network.predict_others(plain), others)
    taken = values.gather(1, samples.actions.long())
    explicit = weight * functional.smooth_l1_loss(taken, taken.detach() - 1) + loss
    expected = th.autograd.grad(explicit, parts)
    assert all(th.allclose(a, b, atol=1e-6) for a, b in zip(found, expected, strict=True))
    assert any(float(a.abs().max()) > 0.01 for a in found)


def test_the_loss_is_the_sum_over_others_and_that_of_the_visible_ones():
    model = played(env_kwargs={"n_agents": 3})
    network, obs = model.q_net, th.zeros(5, 2)
    logits = network.predict_others(obs).detach()
    actions = th.eye(3)[th.tensor([[0, 1], [1, 1], [2, 0], [0, 0], [1, 2]])].reshape(5, 6)
    each = -(logits.reshape(5, 2, 3).log_softmax(-1) * actions.reshape(5, 2, 3)).sum(-1)
    everyone = OthersMinibatch(actions, th.ones(5, 2, dtype=th.bool))
    assert float(network.inference_loss(logits, everyone)) == pytest.approx(float(each.sum(1).mean()), rel=1e-5)
    some = th.tensor([[1, 0], [0, 0], [1, 1], [0, 1], [0, 0]], dtype=th.bool)
    expected = 2 * float(each[some].mean())
    # What was not visible is zero, and does not count
    hidden = OthersMinibatch(actions * some.repeat_interleave(3, dim=1), some)
    assert float(network.inference_loss(logits, hidden)) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(("floor", "weight"), [(0.01, 10.0), (0.25, 2.0)])
def test_the_weight_is_bounded_and_one_without_a_visible_other(floor, weight):
    model = played(inference_floor=floor)
    network = model.q_net
    with th.no_grad():
        network.others.weight.zero_()
        network.others.bias.copy_(th.tensor([50.0, 0, 0]))
    obs, seen = th.zeros(4, 2), th.ones(4, 1, dtype=th.bool)
    sure = OthersMinibatch(th.eye(3)[[0] * 4], seen)
    network(attach(obs, sure))
    network(attach(obs, OthersMinibatch(th.zeros(4, 3), ~seen)))
    (loss, found), (nothing, one) = network.recorded[-2:]
    assert (loss, found) == pytest.approx((0, weight), abs=1e-5) and (nothing, one) == (0, 1)


def test_labels_are_the_actions_of_the_same_step():
    env = make_team_env(ToyEnv, n_envs=2, seed=0)
    team = Team(DPIQN, "MlpPolicy", env, seed=0, **{**Q_KWARGS, "learning_starts": 10**6}).learn(40)
    own, other = (agent.replay_buffer for agent in team.agents.values())
    assert np.array_equal(own.others_actions[:20].argmax(-1), other.actions[:20, :, 0])
    assert np.array_equal(other.others_actions[:20].argmax(-1), own.actions[:20, :, 0])
    assert own.others_visible[:20].all()
    rows = np.arange(5)
    samples = own.samples_of(rows, np.zeros(5, dtype=int))
    assert np.array_equal(attached(samples.observations).actions.numpy(), own.others_actions[:5, 0])


def test_who_is_not_visible_is_no_label():
    env = make_team_env(ScriptedEnv, n_envs=1, seed=0)
    team = Team(DPIQN, "MlpPolicy", env, seed=0, **{**Q_KWARGS, "learning_starts": 10**6}).learn(8)
    buffer = team.agents["last"].replay_buffer
    # Its others are stays (out of play at steps 4 and 5), dies (until step 5) and cut (until step 6)
    assert buffer.others_visible[:8, 0].T.astype(int).tolist() == [
        [1, 1, 1, 0, 0, 1, 1, 1],
        [1, 1, 1, 1, 1, 0, 0, 0],
        [1, 1, 1, 1, 1, 1, 0, 0],
    ]
    assert (buffer.others_actions[:8, 0].reshape(8, 3, 2).sum(-1) == buffer.others_visible[:8, 0]).all()


@BOTH
def test_it_learns_what_others_do(algorithm):
    class Leader(ToyEnv):
        """The second agent is told what to do, and the first sees what it is told."""

        def infos(self):
            return {agent: {"action_mask": np.arange(3) == self.t % 3} if agent == "agent_1" else {} for agent in self.agents}

        def observations(self):
            return {agent: np.eye(3, dtype=np.float32)[self.t % 3] for agent in self.agents}

        def observation_space(self, agent):
            return spaces.Box(0, 1, (3,), np.float32)

    env = make_team_env(Leader, n_envs=4, seed=0, **window(algorithm))
    kwargs = {**Q_KWARGS, "train_freq": 1, "gradient_steps": 2, "learning_rate": 1e-2, "policy_kwargs": {"net_arch": [16]}}
    team = Team(algorithm, "MlpPolicy", env, seed=0, **kwargs).learn(800 if algorithm is DPIQN else 2400)
    model = team.agents["agent_0"]
    obs = model.replay_buffer.observations[:40].reshape(-1, *model.observation_space.shape)
    told = obs.reshape(len(obs), -1)[:, -3:].argmax(1)
    with th.no_grad():
        predicted = model.q_net.predict_others(th.as_tensor(obs)).argmax(1).numpy()
    assert (predicted == told).mean() > 0.95


def test_losses_are_logged():
    env = make_team_env(ToyEnv, n_envs=2, seed=0)
    team = Team(DPIQN, "MlpPolicy", env, seed=0, **Q_KWARGS)
    logged: dict[str, float] = {}

    def keep(locals_, globals_):
        logged.update(team.agents["agent_0"].logger.name_to_value)
        return True

    team.learn(60, agent_callbacks={"agent_0": keep})
    assert logged["train/adaptive_weight"] == pytest.approx(logged["train/inference_loss"] ** -0.5, rel=0.01)


# The target and the masks are those of IQL


@BOTH
def test_the_target_is_that_of_iql(algorithm):
    model = played(algorithm, Choices)
    found, buffer = targets_of(model), model.replay_buffer
    for row in range(buffer.size()):
        next_obs = th.as_tensor(buffer.next_observations[row])
        with th.no_grad():
            online, target = model.q_net(next_obs), model.q_net_target.target(next_obs)
        best = online.masked_fill(~th.as_tensor(buffer.next_masks[row]), -np.inf).argmax(1)
        ended = buffer.dones[row] * (1 - buffer.timeouts[row])
        expected = buffer.rewards[row] + 0.99 * (1 - ended) * target[[0, 1], best].numpy()
        assert found[row] == pytest.approx(expected, abs=1e-5)


# The recurrent one


def test_the_network_reads_the_window_in_order_from_a_state_of_zeros():
    model = played(DRPIQN)
    network = model.q_net
    obs = th.randn(3, 4, 2, generator=th.Generator().manual_seed(0))
    with th.no_grad():
        trunk = network.q_net(obs)
        states = [(th.zeros(1, 3, 8), th.zeros(1, 3, 8)) for _ in range(2)]
        for t in range(4):
            g, states[0] = network.value_memory(network.value_features(trunk[:, t : t + 1]), states[0])
            p, states[1] = network.policy_memory(network.policy_features(trunk[:, t : t + 1]), states[1])
        expected = network.values(g[:, 0] * p[:, 0])
        assert th.allclose(network(obs), expected, atol=1e-6)
        assert th.allclose(network.predict_others(obs), network.others(p[:, 0]), atol=1e-6)
        assert not th.allclose(network(obs.flip(1)), expected, atol=1e-3)


# In a team, saved and loaded


@BOTH
def test_with_masks_saved_and_loaded(algorithm, tmp_path):
    env = make_team_env(Choices, n_envs=2, seed=0, **window(algorithm))
    team = Team(algorithm, "MlpPolicy", env, seed=0, inference_floor=0.1, **Q_KWARGS).learn(80)
    team.save(tmp_path / "team.zip")
    loaded = Team.load(tmp_path / "team.zip", env=env)
    for agent, model in team.agents.items():
        other = loaded.agents[agent]
        assert th.equal(parameters(model), parameters(other))
        assert other.q_net.inference_floor == 0.1 and other.others_action_spaces == model.others_action_spaces
    loaded.learn(40)
    model = team.agents["agent_0"]
    model.save(tmp_path / "agent.zip")
    alone: Any = algorithm.load(tmp_path / "agent.zip")
    obs = model.observation_space.sample()[None]
    assert alone.predict(obs, deterministic=True)[0] == model.predict(obs, deterministic=True)[0]


def test_others_of_several_kinds():
    # Box, MultiDiscrete and others: who predicts a Box is refused, and IQL does without
    env = make_team_env(MixedEnv, n_envs=1, seed=0)
    discrete = [agent for agent in env.possible_agents if isinstance(env.action_space[agent], spaces.Discrete)]
    with pytest.raises(ValueError, match="actions that are numbers"):
        Team({agent: DPIQN if agent == discrete[0] else "PPO" for agent in env.possible_agents}, "MlpPolicy", env)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: DPIQN("MlpPolicy", gym.make("CartPole-v1")), "names no others"),
        (lambda: DPIQN("MlpPolicy", gym.make("CartPole-v1"), inference_floor=0), "inference_floor=0"),
        (lambda: DRPIQN("MlpPolicy", gym.make("CartPole-v1")), "observe_window=12"),
    ],
)
def test_wrong_use(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_another_environment_with_other_others_is_refused(tmp_path):
    model = played()
    model.save(tmp_path / "model")
    team = Team(IQL, "MlpPolicy", make_team_env(ToyEnv, env_kwargs={"n_agents": 3}, seed=0), seed=0, **Q_KWARGS)
    with pytest.raises(ValueError, match="others of this environment"):
        model.set_env(team.agents["agent_0"].get_env())
    with pytest.raises(ValueError, match="others of this environment"):
        DPIQN.load(tmp_path / "model", env=team.agents["agent_0"].get_env())


class Pictures(ToyEnv):
    """A ``ToyEnv`` that shows noise."""

    def observation_space(self, agent):
        return spaces.Box(0, 255, (36, 36, 3), np.uint8)

    def observations(self):
        return {agent: np.random.default_rng(self.t).integers(256, size=(36, 36, 3), dtype=np.uint8) for agent in self.agents}


def test_without_layers_of_its_own_the_trunk_is_what_it_is_given():
    own = {**Q_KWARGS, "policy_kwargs": {}, "buffer_size": 40}
    team = Team(DPIQN, "CnnPolicy", make_team_env(Pictures, n_envs=2, seed=0), seed=0, **own).learn(40)
    assert team.agents["agent_0"].q_net.others.in_features == 512
    narrow = {**Q_KWARGS, "policy_kwargs": {"net_arch": []}}
    for algorithm, width in ((DPIQN, 2), (DRPIQN, 2)):
        env = make_team_env(ToyEnv, n_envs=2, seed=0, **window(algorithm))
        team = Team(algorithm, "MlpPolicy", env, seed=0, **narrow).learn(40)
        assert (
            team.agents["agent_0"].q_net.others.in_features == width and np.isfinite(parameters(team.agents["agent_0"])).all()
        )
