"""
Peak memory of a program that trains a team, each measured in a process of its own.

    python -m benchmarks.memory "junction belief_ppo"

prints MiB.
"""

import argparse
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import torch as th

from benchmarks import growth, teams
from benchmarks.report import Report
from sb3_belief import Team

#: By name: what makes the team
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


def peak_mib() -> float:
    """
    :return: the most memory that this process has held so far, in MiB
    """
    status = Path("/proc/self/status")
    if status.exists():
        # getrusage() also counts what the process had while it was still a copy of the one that started it
        line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) / 1024
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def run(report: Report) -> None:
    """
    :param report: what is found goes there
    """
    iterations = 1 if report.quick else 4
    report.title("e", f"peak memory of a process that learns for {iterations} rollouts and updates")
    names = ["imports only", "junction belief_ppo"] if report.quick else list(PROGRAMS)
    for name in names:
        if name.startswith("smax") and not teams.has_smax():
            report.skip(name, "jaxmarl is not installed")
            continue
        command = [sys.executable, "-m", __name__, name, "--iterations", str(iterations), *["--quick"] * report.quick]
        root = Path(__file__).resolve().parents[1]
        done = subprocess.run(command, cwd=root, stdout=subprocess.PIPE, text=True, check=True)
        report.add_peak(name, float(done.stdout.split()[-1]))


def main() -> None:
    """Train, and print the peak."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=PROGRAMS)
    parser.add_argument("--iterations", type=int, default=4, help="rollouts and updates")
    parser.add_argument("--quick", action="store_true", help="tiny settings")
    args = parser.parse_args()
    th.set_num_threads(1)
    team = PROGRAMS[args.name](args.quick)
    if team is not None:
        loop = teams.TeamLoop(team)
        for _ in range(args.iterations):
            loop()
    print(f"{peak_mib():.1f}")


if __name__ == "__main__":
    main()
