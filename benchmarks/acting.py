"""
How much faster do policies of equal shape act with their forward passes in one batch than one after the other?

One team does both in turns, a rollout each, so that nothing else differs: what it learns is the same to the bit either way.
A policy with a hook makes its forward pass alone. What is compared is the time between the steps of the environment.
"""

from collections.abc import Callable
from contextlib import ExitStack

from benchmarks.measure import Sample, ratio
from benchmarks.report import Report
from benchmarks.teams import ALGOS, TeamLoop, junction_team, spread_team, time_of
from sb3_belief import Team

TOGETHER, APART = "together", "each by itself"


def compare(team: Team, rollouts: int) -> dict[str, list[Sample]]:
    """Return the time between the steps of the environment in several rollouts of each way."""
    loop = TeamLoop(team)
    phases: dict[str, list[dict[str, Sample]]] = {TOGETHER: [], APART: []}
    for i in range(rollouts):
        # Back and forth, so that each way comes first as often as the other
        for way in (TOGETHER, APART)[:: 1 if i % 2 == 0 else -1]:
            with ExitStack() as hooks:
                for model in team.agents.values() if way == APART else ():
                    hooks.callback(model.policy.register_forward_pre_hook(lambda *_: None).remove)
                loop()
            phases[way].append(loop.phases[-1])
    return {way: time_of(found, "acting") for way, found in phases.items()}


def run(report: Report) -> None:
    """Measure part ``together``."""
    report.title("together", "forward passes in one batch against one for each policy, without environment and updates")
    teams: dict[str, Callable[[str, bool], Team]] = {"spread": spread_team, "junction": junction_team}
    warmup = 0 if report.quick else 2
    for name, make in teams.items():
        for algo in ALGOS:
            found = compare(make(algo, report.quick), warmup + report.rounds)
            samples = {f"{name}, {algo}, {way}": taken[warmup:] for way, taken in found.items()}
            together, apart = samples.values()
            report.add_samples("together", samples, "joint steps")
            what = f"{name}, team of {algo}: time of acting each by itself / together"
            report.add_ratio(f"together_vs_apart_{name}_{algo}", ratio(together, apart), what)
