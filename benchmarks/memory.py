"""Peak memory of programs that train a team, each in a process of its own."""

import sys
from collections.abc import Callable
from pathlib import Path

import torch as th

from benchmarks import growth, teams
from benchmarks.loop_process import LoopProcess
from benchmarks.measure import Loop
from benchmarks.report import Report
from sb3_belief import Team

#: What makes the team, by name of the program
PROGRAMS: dict[str, Callable[[bool], Team | None]] = {
    "imports only": lambda quick: None,
    "spread ppo": lambda quick: teams.spread_team("ppo", quick),
    "spread ippo": lambda quick: teams.spread_team("ippo", quick),
    "spread belief_ppo": lambda quick: teams.spread_team("belief_ppo", quick),
    "junction ippo": lambda quick: teams.junction_team("ippo", quick),
    "junction belief_ppo": lambda quick: teams.junction_team("belief_ppo", quick),
    "40 agents, all learn": lambda quick: growth.toy_team("belief_ppo", 40, quick=quick),
    "smax ippo": lambda quick: teams.smax_team("ippo", quick),
    "smax belief_ppo": lambda quick: teams.smax_team("belief_ppo", quick),
}


def peak_kib() -> int:
    """Return the most memory that this process has held so far, in KiB."""
    status = Path("/proc/self/status")
    if status.exists():
        # getrusage() also counts what the process held while it was still a copy of the one that started it
        line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1])
    import resource  # not on Windows

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak // 1024 if sys.platform == "darwin" else peak


def _trainer(name: str, quick: bool, iterations: int) -> Loop:
    th.set_num_threads(1)

    def train() -> int:
        team = PROGRAMS[name](quick)
        if team is not None:
            loop = teams.TeamLoop(team)
            for _ in range(iterations):
                loop()
        return peak_kib()

    return train


def run(report: Report) -> None:
    """Measure part ``e``."""
    iterations = 1 if report.quick else 4
    report.title("e", f"peak memory of a process that learns for {iterations} rollouts and updates")
    for name in ["imports only", "junction belief_ppo"] if report.quick else list(PROGRAMS):
        if name.startswith("smax") and not teams.has_smax():
            report.skip(name, "jaxmarl is not installed")
            continue
        process = LoopProcess(_trainer, name, report.quick, iterations)
        process.start()
        report.add_peak(name, process.steps() / 1024)
        process.close()
