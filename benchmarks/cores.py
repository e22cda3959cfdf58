"""
Two cores against one: Traffic Junction's ten agents with a belief, with two jobs and with one.

The control, ``two_processes_vs_one``, is two such teams in processes of their own that exchange nothing, against one alone: a
team cannot gain more from two cores. Rollouts and updates are also compared apart, since they gain differently.
"""

import statistics

import torch as th

from benchmarks.loop_process import LoopProcess
from benchmarks.measure import cores, ratio
from benchmarks.report import Report
from benchmarks.teams import TeamLoop, junction_team, time_of
from sb3_belief import Team

_KEY, _CONTROL = "two_cores_vs_one", "two_processes_vs_one"
# In each learn(), since with several jobs models travel when it begins and ends
_ROLLOUTS = 3


def largest_difference(a: Team, b: Team) -> float:
    """Return the largest difference between the parameters of two teams: 0 if they have learned the same."""
    differences = []
    with th.no_grad():
        for agent, model in a.agents.items():
            pairs = zip(model.policy.parameters(), b.agents[agent].policy.parameters(), strict=True)
            differences += [float((first - second).abs().max()) for first, second in pairs]
    return max(differences)


def _learner(quick: bool, jobs: int = 1) -> TeamLoop:
    th.set_num_threads(1)
    return TeamLoop(junction_team("belief_ppo", quick, jobs=jobs), _ROLLOUTS)


def run(report: Report) -> None:
    """Measure part ``cores``."""
    report.title("cores", f"Traffic Junction as in b, belief_ppo, {cores()} cores")
    if cores() < 2:
        report.skip(_KEY, "there is one core only")
        return
    one, two, here = _learner(report.quick), _learner(report.quick, jobs=2), _learner(report.quick)
    there = LoopProcess(_learner, report.quick)

    def two_teams() -> int:
        there.start()
        return here() + there.steps()

    samples = report.measure("cores", {"1 job": one, "2 jobs": two, "2 teams": two_teams})
    there.close()
    report.add_ratio(_KEY, ratio(samples["2 jobs"], samples["1 job"], "wall"), "wall speed with two jobs / one")
    for name, phases in {"rollouts": ("environment", "acting"), "updates": ("update",)}.items():
        alone, shared = (time_of(loop.phases[-report.rounds :], *phases) for loop in (one, two))
        seconds = " and ".join(f"{statistics.median(sample.wall for sample in each):.2f} s" for each in (alone, shared))
        report.add_ratio(f"{_KEY}_{name}", ratio(shared, alone, "wall"), f"the same of {name} alone, {seconds}")
    control = ratio(samples["2 teams"], samples["1 job"], "wall")
    report.add_ratio(_CONTROL, control, "wall speed of two teams in processes of their own / one alone")
    difference = largest_difference(one.team, two.team)
    report.time["cores"] = {"largest_difference_of_parameters": difference}
    print(f"  parameters after the same training: {'equal' if difference == 0 else f'they differ by up to {difference:g}'}")
