"""Who ended, who succeeded, who was in play: said of all at once, said early, or said by something that is no flag."""

from typing import Any

import numpy as np
import pytest

from sb3_belief.envs import check_team_env
from tests.field.walkers import Walkers, play
from tests.team.helpers import make_team_env

WHERE = "in environment copy 0 at step 2"


class AllAtOnce(Walkers):
    """Says at step 2, as RLlib's environments do, that everybody has ended, and keeps everybody in ``agents``."""

    part = 2
    own: Any = None

    def change(self, *parts):
        parts[self.part]["__all__"] = self.t == 2
        if self.own is not None:
            parts[3]["walker_0"] = self.own
        return parts


class AllAtOnceWithLists(AllAtOnce):
    """Its rewards are lists, so that all that it returns has to be converted."""

    def change(self, obs, rewards, *rest):
        return super().change(obs, {agent: [reward] for agent, reward in rewards.items()}, *rest)


@pytest.mark.parametrize("kind", [AllAtOnce, AllAtOnceWithLists])
@pytest.mark.parametrize("part", [2, 3])
@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_all_have_ended(kind, part, vec_env):
    env = make_team_env(type("Ends", (kind,), {"part": part}), vec_env=vec_env)
    for t, (_, _, dones, infos) in enumerate(play(env, 4), start=1):
        over = t % 2 == 0
        assert dones.tolist() == [over]
        assert infos[0]["life_end"].tolist() == [over and part == 2] * 2
        assert infos[0]["truncated"].tolist() == [over and part == 3] * 2
        assert infos[0].get("TimeLimit.truncated") == (part == 3 if over else None)
    env.close()


def test_an_entry_of_ones_own_says_more_than_that_of_all():
    class Cut(AllAtOnce):
        own = True

    *_, infos = play(make_team_env(Cut), 2)[1]
    assert infos[0]["life_end"].tolist() == [False, True] and infos[0]["truncated"].tolist() == [True, False]


@pytest.mark.parametrize("part, name", [(2, "terminations"), (3, "truncations")])
def test_an_unknown_agent_that_ends(part, name):
    class Unknown(Walkers):
        def change(self, *parts):
            if self.t == 2:
                parts[part]["all"] = True
            return parts

    with pytest.raises(ValueError, match=f"The environment's {name} have 'all' {WHERE}, which is not among"):
        play(make_team_env(Unknown), 3)
    assert "names" in {finding.topic for finding in check_team_env(Unknown, n_steps=20).failures}


def test_the_checker_reads_what_is_said_of_all():
    class Leave(AllAtOnce):
        """Empties ``agents`` too."""

        def change(self, *parts):
            parts = super().change(*parts)
            if self.t == 2:
                self.agents = []
            return parts

    assert check_team_env(Leave, n_steps=40).failures == []


class Leaves(Walkers):
    """``walker_0`` leaves at step 2 with its verdict; the other plays to the end, with its own."""

    early = True
    late: bool | None = True

    def change(self, *parts):
        if self.t == 2:
            self.agents = ["walker_1"]
            parts[2]["walker_0"] = True
            parts[4]["walker_0"]["is_success"] = self.early
        if not self.agents and self.late is not None:
            parts[4]["walker_1"]["is_success"] = self.late
        return parts


@pytest.mark.parametrize(
    "early, late, whole", [(False, True, False), (True, True, True), (True, None, True), (True, False, False)]
)
@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_the_verdict_of_who_has_left_counts_at_the_end(early, late, whole, vec_env):
    class Once(Leaves):
        def change(self, *parts):
            # In the second episode all succeed: nothing is left of the first
            self.n_ends = getattr(self, "n_ends", 0)
            self.early, self.late = (True, True) if self.n_ends else (early, late)
            parts = super().change(*parts)
            self.n_ends += not self.agents
            return parts

    env = make_team_env(Once, vec_env=vec_env)
    assert [infos[0].get("is_success") for *_, infos in play(env, 8)] == [None, None, None, whole, None, None, None, True]
    env.close()


KEYS = ("active", "next_active", "life_end", "is_success")


def with_flag(key, value):
    class Flag(Walkers):
        def change(self, *parts):
            if self.t == 2:
                parts[4]["walker_1"] = {key: value}
            return parts

    return Flag


@pytest.mark.parametrize("key", KEYS)
@pytest.mark.parametrize("value", ["False", "", np.zeros(2, bool), np.ones(2), [[1], [1, 2]], 0.5, np.nan, {}, []])
def test_what_is_no_flag(key, value):
    with pytest.raises(ValueError) as error:
        play(make_team_env(with_flag(key, value)), 3)
    assert str(error.value).startswith(f"The infos have {key!r} = {value!r} for 'walker_1' {WHERE}: return True or False")


@pytest.mark.parametrize("key", KEYS[:3])
def test_none_is_no_flag_either(key):
    with pytest.raises(ValueError, match=f"The infos have '{key}' = None for 'walker_1' {WHERE}"):
        play(make_team_env(with_flag(key, None)), 3)


def test_none_where_the_success_is_not_known_yet():
    assert "is_success" not in play(make_team_env(with_flag("is_success", None)), 4)[3][3][0]


@pytest.mark.parametrize("key", KEYS)
@pytest.mark.parametrize("value", [True, False])
def test_what_is_one(key, value):
    told = []
    for form in (
        bool,
        np.bool_,
        int,
        float,
        np.int8,
        lambda flag: np.array([flag]),
        lambda flag: np.array(int(flag)),
        lambda flag: [flag],
    ):
        *_, infos = play(make_team_env(with_flag(key, form(value))), 2)[1]
        own = infos[0].get("agent_infos", {}).get("walker_1", {})
        told.append((infos[0]["active"].tolist(), infos[0]["life_end"].tolist(), own))
        assert all(type(flag) is bool for flag in own.values())
    assert all(other == told[0] for other in told)


@pytest.mark.parametrize("part, name", [(2, "terminations"), (3, "truncations")])
@pytest.mark.parametrize("value", ["False", "yes", 0.5, [True, False]])
def test_ends_that_are_no_flags(part, name, value):
    class Text(Walkers):
        def change(self, *parts):
            if self.t == 2:
                parts[part]["walker_0"] = value
            return parts

    with pytest.raises(ValueError) as error:
        play(make_team_env(Text), 3)
    assert str(error.value).startswith(f"The {name} have {value!r} for 'walker_0' {WHERE}: return True or False")


def test_the_checker_counts_early_verdicts():
    class Early(Leaves):
        late = None

    assert "is_success at each end" in str(check_team_env(Early, n_steps=20))
