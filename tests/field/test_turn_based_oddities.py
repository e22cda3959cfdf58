"""Games of turns that PettingZoo's conversions stumble over: no infos, players who are out and wait; and parallel ducks."""

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from pettingzoo import AECEnv

from sb3_belief import BeliefPPO
from sb3_belief.envs import check_team_env, to_parallel
from tests.field.unusual import Duck
from tests.team.helpers import Team, make_team_env

KWARGS: dict[str, Any] = {"n_steps": 24, "batch_size": 24, "n_epochs": 1, "device": "cpu"}


class Ring(AECEnv):
    """
    Players move in turn, nine moves in all; in its second move of an episode, the first one puts the last one out.

    :param waits: Whether whoever is out makes its dead step at its own turn, and not at once
    :param infos: What the infos are: ``"full"``, ``"none"``, ``"empty"``, ``"some"``, or ``"nones"``
    :param parallelizable: What the metadata say; then nobody is put out
    """

    def __init__(self, waits=False, infos="full", parallelizable=False):
        super().__init__()
        self.metadata = {"name": "ring_v0", "is_parallelizable": parallelizable, "render_modes": []}
        self.render_mode = None
        self.possible_agents = ["p0", "p1", "p2"]
        self.waits, self.kind = waits, infos

    def observation_space(self, agent):
        return spaces.Box(0, 20, (1,), np.float32)

    def action_space(self, agent):
        return spaces.Discrete(2)

    def observe(self, agent):
        return np.array([self.n_moves], np.float32)

    def told(self):
        kinds = {"none": None, "empty": {}, "some": {"p0": {"fuel": 1}}, "nones": dict.fromkeys(self.agents)}
        return kinds.get(self.kind, {agent: {} for agent in self.agents})

    def reset(self, seed=None, options=None):
        self.agents, self.n_moves, self.agent_selection = self.possible_agents[:], 0, "p0"
        self.rewards = dict.fromkeys(self.agents, 0.0)
        self._cumulative_rewards = dict(self.rewards)
        self.terminations, self.truncations = dict.fromkeys(self.agents, False), dict.fromkeys(self.agents, False)
        self.infos = self.told()

    def step(self, action):
        mover = self.agent_selection
        following = self.agents[(self.agents.index(mover) + 1) % len(self.agents)]
        if self.terminations[mover]:
            self._was_dead_step(action)
            if self.agents and self.waits:
                self.agent_selection = following
            return
        self._clear_rewards()
        self.rewards[mover] = 1.0
        self.n_moves += 1
        self.infos = self.told()
        self.agent_selection = following
        if self.n_moves == 4 and not self.metadata["is_parallelizable"]:
            self.terminations["p2"] = True
        if self.n_moves == 9:
            self.terminations = dict.fromkeys(self.agents, True)
        self._accumulate_rewards()
        if not self.waits:
            self._deads_step_first()


def waiting():
    return to_parallel(Ring(waits=True))


def at_once():
    return to_parallel(Ring())


def played(make, n_steps=12):
    env = make_team_env(make)
    env.reset()
    return [env.step({agent: np.zeros(1, int) for agent in env.possible_agents}) for _ in range(n_steps)]


def test_who_is_out_and_waits_for_its_turn_has_left():
    assert check_team_env(waiting, n_steps=60).failures == []
    steps = played(waiting)
    ends = [infos[0]["life_end"].tolist() for *_, infos in steps]
    assert ends[:9] == [[False] * 3] * 3 + [[False, False, True]] + [[False] * 3] * 4 + [[True, True, False]]
    assert [dones[0] for _, _, dones, _ in steps] == [t == 8 for t in range(12)]
    # As if it had left at once
    for (obs, rewards, _, infos), (obs_, rewards_, _, infos_) in zip(steps, played(at_once), strict=True):
        assert all(np.array_equal(obs[agent], obs_[agent]) for agent in obs) and rewards == rewards_
        for key in ("active", "life_end", "visible", "agent_rewards"):
            assert np.array_equal(infos[0][key], infos_[0][key]), key
    Team(BeliefPPO, "BeliefPolicy", make_team_env(waiting), **KWARGS).learn(48)


@pytest.mark.parametrize("infos", ["none", "empty", "some", "nones"])
@pytest.mark.parametrize("parallelizable, waits", [(False, False), (False, True), (True, False)])
def test_a_game_whose_infos_lack_agents(infos, parallelizable, waits):
    def make(kind=infos):
        return to_parallel(Ring(waits, kind, parallelizable))

    for (obs, rewards, _, told), (obs_, rewards_, _, _) in zip(played(make), played(lambda: make("full")), strict=True):
        assert all(np.array_equal(obs[agent], obs_[agent]) for agent in obs) and rewards == rewards_
        assert ("fuel" in told[0]) == (infos == "some")
    Team(BeliefPPO, "BeliefPolicy", make_team_env(make), **KWARGS).learn(24)


def test_what_has_the_interface_of_a_parallel_environment_is_taken():
    env = to_parallel(Duck())
    obs, _ = env.reset(seed=1)
    assert list(obs) == env.possible_agents == ["walker_0", "walker_1"]
    rewards = env.step(dict.fromkeys(obs, 0))[1]
    assert list(rewards.values()) == [1, 2]
    Team(BeliefPPO, "BeliefPolicy", make_team_env(lambda: to_parallel(Duck())), **KWARGS).learn(24)
    with pytest.raises(TypeError, match=r"needs an AECEnv or a ParallelEnv of PettingZoo, got object: .*which has no reset"):
        to_parallel(object())
    with pytest.raises(ValueError, match="turn_based=True says how to convert an AECEnv, but Duck is a ParallelEnv"):
        to_parallel(Duck(), turn_based=True)
