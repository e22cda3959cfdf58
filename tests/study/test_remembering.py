"""What a recurrent agent remembers over episodes goes with it into an evaluation, where it is known to need it."""

from functools import partial

import numpy as np
import pytest
from sb3_contrib import RecurrentPPO

from sb3_belief import make_team_env
from sb3_belief.study.meetings import Among, Meeting, Play
from sb3_belief.team import PartnerRecurrentPPO
from tests.team.guest_env import HOSTS, GuestEnv, trained_guest

PLAY = Play(episodes=8, n_envs=8, repetitions=1)


class OneHost(GuestEnv):
    """The same host for ever, who can be told in the first episode, or in none."""

    def __init__(self, host: str, clue: bool):
        super().__init__(every=10**9)
        self.who, self.clue = HOSTS.index(host), clue

    def reset(self, seed=None, options=None):
        super().reset(seed, options)
        self.host = self.who
        return self.observations(), {"guest": {}}

    def observations(self):
        seen = super().observations()
        return seen if self.clue else {"guest": seen["guest"] * np.array([1, 0], dtype=np.float32)}


def beside(team, host, model=None):
    """Return the meeting of a guest with a host whom it can tell while it observes, and not while it is evaluated."""
    env, observed = (
        make_team_env(partial(OneHost, host, clue), n_envs=n, seed=0, partner_starts=True)
        for clue, n in ((False, PLAY.n_envs), (True, 1))
    )
    return Meeting(team, ["guest"], model or team, env, observed)


def returns(meeting, steps):
    return {n: found.outcome.returns.mean() for n, found in meeting.adapt(steps, PLAY, 0).items()}


def test_a_memory_over_episodes_goes_with_the_agent():
    team = trained_guest(PartnerRecurrentPPO)
    found = {host: returns(beside(team, host), (0, 2)) for host in HOSTS}
    # Without the clue it does the same beside both, and so is right beside one of them at the most
    assert found["left"][0] + found["right"][0] == pytest.approx(2.0)
    # A step of [0, clue] and one of [1, clue] are observed
    assert found["left"][2] == found["right"][2] == 2.0
    # With the next partner it begins anew
    assert returns(beside(team, "left"), (0,))[0] == found["left"][0]
    # And as one of the agents among others, who remember nothing
    among = Among(team, "guest", team)
    assert returns(beside(team, "right", among), (0, 2)) == found["right"]


def test_a_memory_of_the_episode_does_not():
    team = trained_guest(RecurrentPPO)
    for host in HOSTS:
        meeting = beside(team, host)
        found = returns(meeting, (0, 2, 3))
        assert found[0] == found[2] == found[3] and not meeting.can_adapt
