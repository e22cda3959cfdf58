"""
Two cores against one: Traffic Junction's ten agents with a belief, side by side or one after the other.

``two_processes_vs_one`` is the control: two such teams, each in a process of its own and without a word between them, against
one alone: a team cannot gain more from the two cores. Rollouts and updates are also timed apart, since they share out
differently.
"""

import statistics
import time
from typing import Any
from unittest import mock

import torch as th

from benchmarks.measure import cores, ratio, spread
from benchmarks.report import Report
from benchmarks.teams import TeamLoop, junction_team
from benchmarks.told import Told
from sb3_belief import Team
from sb3_belief.team.lockstep.joint_loop import JointLoop

_KEY, _CONTROL = "two_cores_vs_one", "two_processes_vs_one"
# In each learn(), since with several jobs models travel at its beginning and its end
_ROLLOUTS = 3


def largest_difference(a: Team, b: Team) -> float:
    """
    :param a: a team
    :param b: another one with the same agents
    :return: the largest difference between a parameter of the one and of the other; 0 if they have learned the same
    """
    differences = []
    for agent, model in a.agents.items():
        pairs = zip(model.policy.parameters(), b.agents[agent].policy.parameters(), strict=True)
        differences += [float((first - second).abs().max()) for first, second in pairs]
    return max(differences)


class _PhasesLoop(TeamLoop):
    """Also notes how many seconds on the wall each of its rollouts and each update of all agents took."""

    def __init__(self, team: Team) -> None:
        super().__init__(team, _ROLLOUTS)
        self.rollouts: list[float] = []
        self.updates: list[float] = []

    def __call__(self) -> int:
        end_rollouts, seconds = JointLoop._end_rollouts, []

        def timed(*args: Any) -> None:
            start = time.perf_counter()
            end_rollouts(*args)
            seconds.append(time.perf_counter() - start)

        start = time.perf_counter()
        with mock.patch.object(JointLoop, "_end_rollouts", timed):
            steps = super().__call__()
        self.updates.append(sum(seconds))
        self.rollouts.append(time.perf_counter() - start - sum(seconds))
        return steps


def _learner(quick: bool) -> TeamLoop:
    th.set_num_threads(1)
    return TeamLoop(junction_team("belief_ppo", quick), _ROLLOUTS)


def run(report: Report) -> None:
    """
    :param report: what is found goes there
    """
    report.title("cores", f"Traffic Junction as in b, belief_ppo, {cores()} cores")
    if cores() < 2:
        report.skip(_KEY, "there is one core only")
        return
    loops = {f"{n} job{'s' * (n > 1)}": _PhasesLoop(junction_team("belief_ppo", report.quick, jobs=n)) for n in (1, 2)}
    one, two = loops.values()
    here, there = _learner(report.quick), Told(_learner, report.quick)

    def two_teams() -> int:
        there.tell()
        return here() + there.steps()

    samples = report.measure("cores", {**loops, "2 teams": two_teams})
    there.end()
    report.add_ratio(_KEY, ratio(samples["2 jobs"], samples["1 job"], "wall"), "wall speed with two jobs / one")
    for phase in ("rollouts", "updates"):
        # Without those that warmed up
        seconds = [getattr(loop, phase)[-report.rounds :] for loop in (one, two)]
        found = spread([a / b for a, b in zip(*seconds, strict=True)])
        medians = " and ".join(f"{statistics.median(each):.2f} s" for each in seconds)
        report.add_ratio(f"{_KEY}_{phase}", found, f"the same of {phase} alone, {medians}")
    control = ratio(samples["2 teams"], samples["1 job"], "wall")
    report.add_ratio(_CONTROL, control, "wall speed of two teams in processes of their own / one alone")
    with th.no_grad():
        difference = largest_difference(one.team, two.team)
    report.time["cores"] = {"largest_difference_of_parameters": difference}
    print(f"  parameters after the same training: {'equal' if difference == 0 else f'they differ by up to {difference:g}'}")
