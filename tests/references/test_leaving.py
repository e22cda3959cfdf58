"""Agents that leave the team before the others, in learners that act for all."""

from itertools import count
from typing import Any, ClassVar

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sb3_belief.references import MADDPG, JointVecEnv, ValueFactorisation
from tests.team.helpers import make_team_env
from tests.team.toy_envs import ScriptedEnv

VALUES: dict[str, Any] = dict(mixer="vdn", policy_kwargs={"hidden_dim": 8, "recurrent": False}, seed=0, learning_rate=0.0)


class Leaves(ParallelEnv):
    """
    Two agents who see the step and may do 0 and 1, never 2. "b" terminates at ``leaves``, before the end.

    :param length: Steps of an episode
    :param leaves: When "b" leaves
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "leaves"}
    render_mode = None

    def __init__(self, length: int = 4, leaves: int = 2):
        self.possible_agents = ["a", "b"]
        self.agents: list[str] = []
        self.length, self.leaves, self.t = length, leaves, 0

    def observation_space(self, agent):
        return spaces.Box(0, 10, (1,), np.float32)

    def action_space(self, agent):
        return spaces.Discrete(3)

    def reset(self, seed=None, options=None):
        self.t, self.agents = 0, ["a", "b"]
        return self._observe(), self._infos()

    def step(self, actions):
        self.t += 1
        obs, infos = self._observe(), self._infos()
        if self.t == self.leaves:
            # As most environments: what has left has no mask
            infos["b"] = {}
        ends = {agent: self.t == self.length or (agent, self.t) == ("b", self.leaves) for agent in self.agents}
        self.agents = [agent for agent in self.agents if not ends[agent]]
        return obs, dict.fromkeys(ends, 1.0), ends, dict.fromkeys(ends, False), infos

    def _observe(self):
        return {agent: np.array([self.t], dtype=np.float32) for agent in self.agents}

    def _infos(self):
        return {agent: {"action_mask": np.array([True, True, False])} for agent in self.agents}


def test_who_has_left_has_one_legal_action():
    env = JointVecEnv(make_team_env(Leaves, n_envs=1))
    masks = [np.asarray(env.reset()["mask"])[0, 1].tolist()]
    for _ in range(3):
        env.step_async(np.zeros((1, 2), dtype=np.int64))
        obs: Any = env.step_wait()[0]
        masks.append(obs["mask"][0, 1].tolist())
    assert masks == [[1, 1, 0], [1, 1, 0], [1, 0, 0], [1, 0, 0]]
    env.step_async(np.zeros((1, 2), dtype=np.int64))
    obs, _, dones, infos = env.step_wait()
    assert isinstance(obs, dict)
    assert dones.all() and infos[0]["terminal_observation"]["mask"].tolist() == [[1, 1, 0], [1, 0, 0]]
    assert obs["mask"][0].tolist() == [[1, 1, 0]] * 2


def test_what_nobody_may_do_is_in_no_target():
    env = JointVecEnv(make_team_env(Leaves, n_envs=2))
    model = ValueFactorisation("FactorisedPolicy", env, batch_size=2, buffer_size=20, **VALUES).learn(16)
    batch = model.replay_buffer.batch(model.replay_buffer.episodes[:2])
    assert (batch.actions < 2).all() and (batch.actions[:, 2:, 1] == 0).all()
    before = model.targets(batch)
    for net in (model.policy.net, model.policy.target_net):
        nets: Any = net.agents.nets
        nets[0].last.bias.data[2] += 100
    assert np.array_equal(model.targets(batch), before)


def test_maddpg_bootstraps_from_an_agents_own_last_observation_and_leaves_out_what_follows():
    env = JointVecEnv(make_team_env(ScriptedEnv, n_envs=1, seed=0))
    model = MADDPG("MaddpgPolicy", env, batch_size=8, learning_starts=10**6, buffer_size=8, seed=0).learn(8)
    replay: Any = model.replay_buffer
    # The step that "dies", "cut" and "last" see where their own returns end
    at = {(4, 1): 5.0, (5, 2): 6.0, (7, 3): 8.0}
    for (step, agent), last in at.items():
        assert replay.next_observations["obs"][step, 0, agent, 0] == last
    ends = {"dies": replay.own_ends[4, 0, 1], "cut": replay.own_ends[5, 0, 2], "last": replay.own_ends[7, 0, 3]}
    assert ends == {"dies": 1.0, "cut": 0.0, "last": 0.0}
    samples = replay._get_samples(np.arange(8))
    # "cut" is out of play at the last two steps, which therefore count for nothing
    rewards = samples.rewards.clone()

    def loss():
        # The next actions are drawn
        th.manual_seed(0)
        return model.critic_loss(samples._replace(rewards=rewards)).item()

    before = loss()
    rewards[6:, 2] += 1000
    assert loss() == before
    rewards[5, 2] += 1000
    assert loss() > before + 1000


@pytest.mark.parametrize("n_envs", [2, 4, 8])
def test_an_update_follows_as_many_episodes_as_there_are_copies(n_envs):
    """Also where half of the copies have episodes of two steps, the others of three."""
    numbers = count()
    env = JointVecEnv(make_team_env(lambda: Leaves(length=2 + next(numbers) % 2, leaves=1), n_envs=n_envs))
    model = ValueFactorisation("FactorisedPolicy", env, batch_size=1, buffer_size=50, **VALUES).learn(n_envs * 120)
    assert model._n_episodes == n_envs * 50 and model._n_updates == 50
