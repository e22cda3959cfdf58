"""Runs that are killed at drawn moments, again and again, go on to the end of their undisturbed twins, bit for bit."""

import os
import random
from pathlib import Path

import pytest

from tests.reliability.combinations import BELIEF, OTHERS, check_equal_to
from tests.reliability.kills import Killed, drawn_kills, undisturbed
from tests.reliability.processes import Launcher

pytestmark = pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="looks for processes in /proc")

#: How often each is killed, together ten times
KILLS = dict(zip(BELIEF, (2, 2, 1, 1, 1, 1, 2), strict=True))


@pytest.fixture(scope="module")
def launcher(tmp_path_factory):
    launcher = Launcher(tmp_path_factory.mktemp("outputs"))
    yield launcher
    launcher.close()


def check(launcher, combination, folder, seed, kills):
    """Compare a run with kills, whose first is one of a whole command line if there are several, with one without."""
    twin, seconds = undisturbed(launcher, combination, folder / "undisturbed", seed)
    killed = Killed(launcher, combination, folder / "killed", seed, seconds)
    for i, (share, while_saving) in enumerate(kills):
        killed.kill(share, while_saving, anew=i == 1)
    killed.finish()
    assert check_equal_to(killed.run, twin) > 0


def test_ten_kills_are_drawn_over_all_settings():
    assert sum(KILLS.values()) == 10
    words = [" ".join(each.command(Path("logs"), 0)) for each in BELIEF.values()]
    for present in ("traffic-junction", "mpe/", "lbf/", "convention-swap", "subproc", "--jobs 2", "normalize:true"):
        found = [present in line for line in words]
        assert any(found) and not all(found)


def test_a_run_that_is_killed_twice_ends_as_its_undisturbed_twin(tmp_path, launcher):
    combination = BELIEF["convention, dummy, 1 job, normalize"]
    check(launcher, combination, tmp_path, 5, [(0.3, False), (0.2, True)])


@pytest.mark.slow
@pytest.mark.parametrize("name", BELIEF)
def test_killed_teams_of_belief_ppo_end_as_their_undisturbed_twins(tmp_path, launcher, name):
    check(launcher, BELIEF[name], tmp_path, 3, drawn_kills(random.Random(name), KILLS[name]))


@pytest.mark.slow
@pytest.mark.parametrize("name", OTHERS)
def test_so_do_teams_of_other_algorithms(tmp_path, launcher, name):
    check(launcher, OTHERS[name], tmp_path, 3, drawn_kills(random.Random(name), 1))
