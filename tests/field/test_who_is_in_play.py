"""Who enters, leaves and comes back: the team's episode goes on until all have left, and none is forgotten."""

import numpy as np
import pytest
from stable_baselines3 import PPO

from tests.field.walkers import Walkers, play
from tests.team.helpers import PPO_KWARGS, Team, make_team_env


class Shifts(Walkers):
    """
    Agents in play by shifts: ``plan[t]`` names, by their numbers, those that are in play after step t.

    :param plan: One string for each step, the reset first
    :param cut: Whether who leaves is truncated instead of terminated
    :param n_agents: Number of agents
    :param ends: For a step, those that end in it although they stay in play
    """

    def __init__(self, plan: list[str], cut: bool = False, n_agents: int = 2, ends: dict[int, str] | None = None):
        super().__init__(n_agents)
        self.plan, self.cut, self.ends = plan, cut, ends or {}

    def named(self, numbers):
        return [self.possible_agents[int(number)] for number in numbers]

    def reset(self, seed=None, options=None):
        super().reset()
        self.agents = self.named(self.plan[0])
        return {agent: self.observe(agent) for agent in self.agents}, {agent: {} for agent in self.agents}

    def step(self, actions):
        assert set(actions) == set(self.agents)
        self.t += 1
        acted, self.agents = self.agents, self.named(self.plan[self.t])
        told = list(dict.fromkeys([*acted, *self.agents]))
        over = {agent: agent in acted and agent not in self.agents for agent in told}
        over |= dict.fromkeys(self.named(self.ends.get(self.t, "")), True)
        flags = dict.fromkeys(told, False)
        return (
            {agent: self.observe(agent) for agent in told},
            {agent: 1.0 for agent in told},
            flags if self.cut else over,
            over if self.cut else flags,
            {agent: {} for agent in told},
        )


def told(plan, **kwargs):
    """For each step of one episode: who was active, whose return ended and was cut, and whether the team's episode ended."""
    env = make_team_env(lambda: Shifts(plan, **kwargs))
    rows = []
    for _, _, dones, infos in play(env, len(plan) - 1):
        flags = ["".join(str(int(flag)) for flag in infos[0][key]) for key in ("active", "life_end", "truncated")]
        rows.append((*flags, bool(dones[0])))
    return rows


def test_a_relay_is_one_episode():
    expected = [("10", "00", "00", False), ("10", "10", "00", False), ("01", "00", "00", False), ("01", "01", "00", True)]
    assert told(["0", "0", "1", "1", ""]) == expected


def test_a_relay_of_truncated_agents_is_one_episode():
    expected = [("10", "00", "10", False), ("01", "00", "00", False), ("01", "00", "01", True)]
    assert told(["0", "1", "1", ""], cut=True) == expected


def test_all_end_while_others_enter_and_one_comes_back_later():
    rows = told(["01", "2", "0", "0", ""], n_agents=3)
    assert rows == [
        ("110", "110", "000", False),
        ("001", "001", "000", False),
        ("100", "000", "000", False),
        ("100", "100", "000", True),
    ]


def test_who_ends_and_comes_back_at_once_begins_a_new_life():
    assert told(["01", "01", "01", ""], ends={1: "0"})[:2] == [("11", "10", "00", False), ("11", "00", "00", False)]
    # Another one enters in the same step
    assert told(["0", "01", ""], ends={1: "0"}) == [("10", "10", "00", False), ("11", "11", "00", True)]


def test_all_that_are_in_play_have_ended_though_the_environment_still_lists_them():
    assert told(["01", "01", "01"], ends={1: "01"})[0] == ("11", "11", "00", True)


def test_a_relay_trains():
    env = make_team_env(lambda: Shifts(["0", "0", "1", "1", ""]), n_envs=2)
    team = Team(PPO, "MlpPolicy", env, seed=0, **PPO_KWARGS).learn(32)
    assert team.ep_info_buffer[-1]["l"] == 4


class OneList(Walkers):
    """``agents`` and ``possible_agents`` are one list, from which who leaves is removed."""

    def reset(self, seed=None, options=None):
        result = super().reset()
        self.agents = self.possible_agents
        return result

    def step(self, actions):
        self.t += 1
        acted = list(self.agents)
        ends = {agent: self.t >= 2 + int(agent[-1]) for agent in acted}
        for agent in acted:
            if ends[agent]:
                self.agents.remove(agent)
        obs = {agent: np.zeros(3, np.float32) for agent in acted}
        return obs, dict.fromkeys(acted, 1.0), ends, dict.fromkeys(acted, False), {agent: {} for agent in acted}


class OneListOfTheClass(OneList):
    possible_agents = ["walker_0", "walker_1"]  # noqa: RUF012 (that is the fault)

    def __init__(self):
        super().__init__()
        del self.possible_agents


@pytest.mark.parametrize("kind", [OneList, OneListOfTheClass])
def test_an_agent_of_a_shrinking_list_returns(kind):
    active = [infos[1]["active"].tolist() for *_, infos in play(make_team_env(kind, n_envs=2), 6)]
    assert active == [[True, True], [True, True], [False, True]] * 2


def test_a_list_that_shrinks_elsewhere_is_refused():
    class Alive(OneList):
        agents = property(lambda self: self.possible_agents, lambda self, agents: None)

    message = (
        r"possible_agents of Alive were \['walker_0', 'walker_1'\] and are \['walker_1'\] in environment copy 0 at step 2:"
        r".*begin episodes with self.agents = list\(self.possible_agents\)"
    )
    with pytest.raises(ValueError, match=message):
        play(make_team_env(Alive), 3)


class NoLastWords(Walkers):
    """At the time limit there are no observations."""

    active = True

    def change(self, obs, rewards, terminations, truncations, infos):
        if not self.agents:
            obs, infos = {}, {agent: {"active": self.active} for agent in infos}
        return obs, rewards, terminations, truncations, infos


@pytest.mark.parametrize("n_agents", [1, 2])
def test_a_limit_without_last_observations_is_refused(n_agents):
    message = "truncates 'walker_0' in environment copy 0 at step 4 without returning a last observation"
    with pytest.raises(ValueError, match=message):
        play(make_team_env(lambda: NoLastWords(n_agents)), 4)


def test_who_leaves_before_the_others_needs_a_last_observation_too():
    class Leaves(Shifts):
        def step(self, actions):
            obs, *parts = super().step(actions)
            return {agent: obs[agent] for agent in self.agents}, *parts

    with pytest.raises(ValueError, match="truncates 'walker_1' in environment copy 0 at step 1 without returning"):
        play(make_team_env(lambda: Leaves(["01", "0", ""], cut=True)), 1)
    # Nothing is bootstrapped where a return has ended
    assert play(make_team_env(lambda: Leaves(["01", "0", ""])), 1)[0][3][0]["life_end"].tolist() == [False, True]


def test_nothing_is_bootstrapped_for_who_was_out_of_play():
    class Dead(NoLastWords):
        active = False

    assert play(make_team_env(Dead), 4)[-1][2].all()
