"""
How fast is a team, and where does the time go? What is compared takes turns within one run; medians with quartiles are shown.

    make bench
    make bench BENCH_ARGS="--parts a b --rounds 15"

Parts:

- ``a``: three learners on mpe2's simple_spread (8 copies x 128 steps, 10 epochs, 4 minibatches, 64x64 tanh): three stock PPOs
  by hand, the same as a team, BeliefPPO without a belief (ippo) and with the paper's
- ``b``: ten learners on Traffic Junction (medium), 32 copies, with the settings of zoo_configs/belief_ppo.yml
- ``c``: eight learners on SMAX's 3s5z, where jaxmarl is installed
- ``together``: the teams of ``a`` and ``b`` with forward passes in one batch, against one forward pass per policy
  (benchmarks/acting.py)
- ``d``: growth with the number of agents, copies, remembered steps and others (benchmarks/growth.py)
- ``e``: peak memory, each program in a process of its own
- ``cores``: two cores against one
- ``workers``: an environment whose step takes 10 ms, in worker processes (benchmarks/heavy.py)
- ``finite``: updates with the search for what is not finite, against updates alone (benchmarks/finite.py)
- ``checkpoints``: learning with the checkpoints that a run has by default, against without (benchmarks/checkpoints.py)
- ``partners``: one learner among nine partners: a pool of saved teams against one, and functions of batches against the
  callables of an ``AgentEnv`` (benchmarks/partners.py)
- ``scripted``: one learner among nine scripted cars in one batch, against nine callables (benchmarks/scripted.py)
- ``adaptive``: one learner with an adaptive belief against one with the paper's and one without (benchmarks/adaptive.py)
- ``gpu``: updates on a GPU against the CPU, where there is a GPU

torch uses one thread. Speeds are joint steps (of one copy) per second of CPU time, including that of workers, and per second
of wall-clock time. Nothing fails for being slow: the aims are printed beside the values. The JSON file has the same numbers
and more.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import torch as th

from benchmarks import acting, adaptive, checkpoints, cores, finite, gpu, growth, heavy, memory, partners, scripted
from benchmarks.measure import Loop, Sample, ratio
from benchmarks.report import Report
from benchmarks.teams import (
    ALGOS,
    SPREAD_ENVS,
    TeamLoop,
    has_smax,
    junction_team,
    milliseconds,
    smax_team,
    spread_settings,
    spread_team,
)
from sb3_belief import Team

OUT = Path(__file__).resolve().parent / "out" / "bench.json"


def spread(report: Report) -> None:
    """Measure part ``a``."""
    # Imported here because it imports mpe2, which is missing where SMAX is measured
    from benchmarks.by_hand import ByHand, ByHandOnTeamEnv

    report.title("a", "three learners on simple_spread")
    settings = spread_settings(report.quick)
    by_hand: dict[str, Loop] = {
        "three PPOs by hand": ByHand(SPREAD_ENVS, settings),
        "the same on the team's environment": ByHandOnTeamEnv(SPREAD_ENVS, settings),
    }
    samples = _teams(report, "a", {algo: spread_team(algo, report.quick) for algo in ("ppo", *ALGOS)}, others=by_hand)
    hand, same_env, ppo, ippo, belief = samples
    report.add_ratio("lockstep_vs_hand", ratio(ppo, hand), "team of stock PPOs / three PPOs by hand")
    report.add_ratio("ippo_vs_hand", ratio(ippo, hand), "team of ippo / three PPOs by hand")
    report.add_ratio("lockstep_vs_same_env", ratio(ppo, same_env), "team of stock PPOs / by hand on the team's environment")
    report.add_ratio("ippo_vs_same_env", ratio(ippo, same_env), "team of ippo / by hand on the team's environment")
    report.add_ratio("belief_vs_ippo_spread", ratio(belief, ippo), "team of belief_ppo / team of ippo")


def junction(report: Report) -> None:
    """Measure part ``b``."""
    report.title("b", "ten learners on traffic-junction-medium")
    # Agents remember only the steps in which they are in play, so it takes two rollouts to fill their histories
    ippo, belief = _teams(report, "b", {algo: junction_team(algo, report.quick) for algo in ALGOS}, warmup=2)
    report.add_ratio("belief_vs_ippo_junction", ratio(belief, ippo), "team of belief_ppo / team of ippo")


def smax(report: Report) -> None:
    """Measure part ``c``."""
    report.title("c", "eight learners with action masks on SMAX's 3s5z")
    if not has_smax():
        report.skip("c", "jaxmarl is not installed")
        return
    ippo, belief = _teams(report, "c", {algo: smax_team(algo, report.quick) for algo in ALGOS})
    report.add_ratio("belief_vs_ippo_smax", ratio(belief, ippo), "team of belief_ppo / team of ippo")


def _teams(
    report: Report, part: str, teams: dict[str, Team], others: dict[str, Loop] | None = None, warmup: int = 1
) -> list[list[Sample]]:
    """Measure teams, after other loops, and where their time goes; return the samples of all, in order."""
    loops = {algo: TeamLoop(team) for algo, team in teams.items()}
    named: dict[str, Loop] = {f"team of {algo}": loop for algo, loop in loops.items()}
    samples = report.measure(part, {**(others or {}), **named}, warmup=warmup)
    report.add_phases(part, {algo: milliseconds(loop.phases[-report.rounds :]) for algo, loop in loops.items()})
    return list(samples.values())


PARTS: dict[str, Callable[[Report], None]] = {
    "a": spread,
    "b": junction,
    "c": smax,
    "together": acting.run,
    "d": growth.run,
    "e": memory.run,
    "cores": cores.run,
    "workers": heavy.run,
    "finite": finite.run,
    "checkpoints": checkpoints.run,
    "partners": partners.run,
    "scripted": scripted.run,
    "adaptive": adaptive.run,
    "gpu": gpu.run,
}


def main(arguments: list[str] | None = None) -> None:
    """
    Measure, print and write.

    :param arguments: Arguments of the command line
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), metavar="PART", help="what to measure")
    parser.add_argument("--rounds", type=int, default=None, help="measurements of each loop (default 7; 1 with --quick)")
    parser.add_argument("--quick", action="store_true", help="make everything tiny, as a test: the numbers mean nothing")
    parser.add_argument("--out", type=Path, default=OUT, help="the JSON file")
    args = parser.parse_args(arguments)
    th.set_num_threads(1)
    report = Report(args.rounds or (1 if args.quick else 7), args.quick)
    for part in dict.fromkeys(args.parts):
        PARTS[part](report)
    report.write(args.out)


if __name__ == "__main__":
    main()
