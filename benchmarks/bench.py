"""
How fast is it, and where does the time go? All in one run, what is compared in turn, medians with quartiles.

    make bench
    make bench BENCH_ARGS="--parts a b --rounds 15"

Parts:

- ``a``: three learners on mpe2's simple_spread (8 copies x 128 steps, 10 epochs, 4 minibatches, 64x64 tanh): three stock PPOs
  by hand, the same as a team, BeliefPPO without a belief (ippo) and with the paper's
- ``b``: ten learners on Traffic Junction (medium), 32 copies, the settings of zoo_configs/belief_ppo.yml
- ``c``: eight learners on SMAX's 3s5z, where jaxmarl is installed
- ``together``: the teams of ``a`` and ``b`` as they are, whose policies act together, against each policy by itself
  (benchmarks/acting.py)
- ``d``: growth with the number of agents, copies, remembered steps and others (benchmarks/growth.py)
- ``e``: peak memory, each program in a process of its own
- ``cores``: two cores against one
- ``workers``: an environment whose step takes 10 ms, in worker processes (benchmarks/heavy.py)
- ``gpu``: updates on a GPU against the CPU, where there is one

One thread of torch. Speeds are joint steps (of one copy) per second of CPU time, that of workers included, and per second on
the wall. Nothing fails for being slow: bars are printed beside the values. The JSON has the same numbers and more.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import torch as th

from benchmarks import acting, breakdown, cores, gpu, growth, heavy, memory
from benchmarks.measure import Loop, ratio
from benchmarks.report import Report
from benchmarks.teams import (
    ALGOS,
    SPREAD_ENVS,
    TeamLoop,
    has_smax,
    junction_team,
    smax_team,
    spread_settings,
    spread_team,
)

OUT = Path(__file__).resolve().parent / "out" / "bench.json"


def spread(report: Report) -> None:
    """
    :param report: what is found goes there
    """
    # Here, since it imports mpe2: SMAX is measured in an environment without it
    from benchmarks.by_hand import ByHand, ByHandOnTeamEnv

    report.title("a", "three learners on simple_spread")
    quick, settings = report.quick, spread_settings(report.quick)
    loops: dict[str, Loop] = {
        "three PPOs by hand": ByHand(SPREAD_ENVS, settings).iterate,
        "the same on the team's environment": ByHandOnTeamEnv(SPREAD_ENVS, settings).iterate,
        **{f"team of {algo}": TeamLoop(spread_team(algo, quick)) for algo in ("ppo", *ALGOS)},
    }
    samples = report.measure("a", loops)
    hand, same_env, ppo, ippo, belief = samples.values()
    report.add_ratio("lockstep_vs_hand", ratio(ppo, hand), "team of stock PPOs / three PPOs by hand")
    report.add_ratio("ippo_vs_hand", ratio(ippo, hand), "team of ippo / three PPOs by hand")
    report.add_ratio("lockstep_vs_same_env", ratio(ppo, same_env), "team of stock PPOs / by hand on the team's environment")
    report.add_ratio("ippo_vs_same_env", ratio(ippo, same_env), "team of ippo / by hand on the team's environment")
    report.add_ratio("belief_vs_ippo_spread", ratio(belief, ippo), "team of belief_ppo / team of ippo")
    breakdown.compare(report, "a", {algo: spread_team(algo, quick) for algo in ("ppo", *ALGOS)})


def junction(report: Report) -> None:
    """
    :param report: what is found goes there
    """
    report.title("b", "ten learners on traffic-junction-medium")
    loops = {f"team of {algo}": TeamLoop(junction_team(algo, report.quick)) for algo in ALGOS}
    # Agents remember only steps in which they are in play: two rollouts until their histories are full
    samples = report.measure("b", loops, warmup=2)
    ippo, belief = samples.values()
    report.add_ratio("belief_vs_ippo_junction", ratio(belief, ippo), "team of belief_ppo / team of ippo")
    breakdown.compare(report, "b", {algo: junction_team(algo, report.quick) for algo in ALGOS})


def smax(report: Report) -> None:
    """
    :param report: what is found goes there
    """
    report.title("c", "eight learners with action masks on SMAX's 3s5z")
    if not has_smax():
        report.skip("c", "jaxmarl is not installed")
        return
    loops = {f"team of {algo}": TeamLoop(smax_team(algo, report.quick)) for algo in ALGOS}
    samples = report.measure("c", loops)
    ippo, belief = samples.values()
    report.add_ratio("belief_vs_ippo_smax", ratio(belief, ippo), "team of belief_ppo / team of ippo")
    breakdown.compare(report, "c", {algo: smax_team(algo, report.quick) for algo in ALGOS})


PARTS: dict[str, Callable[[Report], None]] = {
    "a": spread,
    "b": junction,
    "c": smax,
    "together": acting.run,
    "d": growth.run,
    "e": memory.run,
    "cores": cores.run,
    "workers": heavy.run,
    "gpu": gpu.run,
}


def main(arguments: list[str] | None = None) -> None:
    """
    Measure, print and write.

    :param arguments: of the command line
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), metavar="PART", help="what to measure")
    parser.add_argument("--rounds", type=int, default=None, help="measurements of each (default 7; 1 if quick)")
    parser.add_argument("--quick", action="store_true", help="everything tiny, to see that it runs: the numbers mean nothing")
    parser.add_argument("--out", type=Path, default=OUT, help="the JSON file")
    args = parser.parse_args(arguments)
    th.set_num_threads(1)
    report = Report(args.rounds or (1 if args.quick else 7), args.quick)
    for part in dict.fromkeys(args.parts):
        PARTS[part](report)
    report.write(args.out)


if __name__ == "__main__":
    main()
