"""
How fast are other libraries at the same? Three independent PPOs with networks of their own on mpe2's simple_spread.

    make bench-peers
    make bench-peers BENCH_ARGS="--rounds 9 --peers rllib"

Everyone trains 8 copies x 128 steps, then 10 epochs of 4 minibatches, 64x64 tanh networks for the policy and the value, with
one thread of torch on the CPU. Each program is a process in the environment of its library (see the files of this folder: they
say where a library differs, and ``<library>.txt`` has its pins). All are started, and warmed up by one iteration, before any
is measured; then they take turns, one iteration each, back and forth, and only one works at a time.

Speeds are joint steps (of one copy) per CPU second, of the program and all processes that it started, and per second on the
wall. What was done in the first iteration is counted: steps of the environments and of the optimisers, and the parameters that
these changed. The best peer is the fastest program here, also where it has a loop of ours. The environments alone are measured
too, since nobody can be faster; ``..._besides_env`` are the ratios of what is left. A library that cannot be installed or that
fails is skipped, saying why.
"""

import argparse
import statistics
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from benchmarks.measure import Sample, Spread, alternate, ratio, speeds
from benchmarks.peers.programs import ROOT, Program
from benchmarks.report import Report, versions, write_json

OUT = ROOT / "benchmarks" / "out" / "peers.json"
VENVS = ROOT / ".venv-peers"
#: By key of their ratios: name, arguments of the program
OURS = {"ippo": ("team of ippo", "ippo"), "ppo": ("team of ppo", "ppo"), "by_hand": ("three PPOs by hand", "by_hand")}
#: Name, library, further arguments of its program
PEERS = {
    "rllib": ("RLlib", "rllib"),
    "agilerl": ("AgileRL, copies in a loop of ours", "agilerl"),
    "agilerl_processes": ("AgileRL, copies in its processes", "agilerl", "--processes"),
    "benchmarl": ("BenchMARL", "benchmarl"),
}


class PeerReport(Report):
    """What is measured here, printed as ``make bench`` does."""

    bars = MappingProxyType({"ippo_vs_best_peer": (">=", 2.0), "ppo_vs_best_peer": (">=", 2.0)})

    def add_programs(self, programs: Mapping[str, Program]) -> None:
        """
        :param programs: that were measured
        """
        self.add_samples("peers", {program.name: program.samples for program in programs.values()}, "joint steps")
        print("  in the first iteration; CPU time while others work:")
        for key, program in programs.items():
            self.time[key] = {**program.about, "idle_share_of_a_core": program.idle_share}
            work = ", ".join(f"{number:,} {what.replace('_', ' ')}" for what, number in program.about.get("work", {}).items())
            print(f"  {program.name}: {work}; {program.idle_share:.1%} of a core")

    def add_ratio(self, key: str, found: Spread, text: str) -> None:
        super().add_ratio(key, found, text)
        # Not only those with a bar: which library is the best one may change
        self.ratios[key] = found.median

    def write(self, path: Path) -> None:
        details = {"rounds": self.rounds, "quick": self.quick, "rows": self.rows, "ratios": self.ratio_rows}
        found = {"programs": self.time, "skipped": self.skipped, "details": details}
        write_json({"ratios": self.ratios, "versions": versions(), **found}, path)


def compare(report: PeerReport, ours: Mapping[str, Program], peers: Mapping[str, Program], env: Program) -> None:
    """
    Start all, measure those that work in turns, and stop them.

    :param report: what is found goes there
    :param ours: our programs, by key
    :param peers: those of others, by key
    :param env: the environments alone
    """
    programs = {**ours, **peers, "env": env}
    try:
        for program in programs.values():
            program.start()
        # Who fails in the middle does nothing in later turns
        alternate({key: each.turn for key, each in programs.items() if each.error is None}, report.rounds, warmup=0)
    finally:
        for program in programs.values():
            program.stop()
    for program in programs.values():
        if program.error is not None:
            report.skip(program.name, program.error)
    working = {key: program for key, program in programs.items() if program.error is None}
    if working:
        report.add_programs(working)
    samples = {key: program.samples for key, program in working.items()}
    names = {key: program.name for key, program in working.items()}
    add_ratios(report, samples, names, list(ours), list(peers))
    add_ratios(report, samples, names, list(ours), list(peers), "wall", "_wall", ", on the wall")
    if "env" in working:
        rest = {key: besides(taken, samples["env"]) for key, taken in samples.items() if key != "env"}
        add_ratios(report, rest, names, list(ours), list(peers), "cpu", "_besides_env", ", without what the environments take")


def besides(samples: Sequence[Sample], env: Sequence[Sample]) -> list[Sample]:
    """
    :param samples: measurements of a program
    :param env: of the environments alone, in the same rounds
    :return: what the program takes besides
    """
    return [
        Sample(own.steps, own.cpu - each.cpu * own.steps / each.steps, own.wall - each.wall * own.steps / each.steps)
        for own, each in zip(samples, env, strict=True)
    ]


def add_ratios(
    report: PeerReport,
    samples: Mapping[str, Sequence[Sample]],
    names: Mapping[str, str],
    ours: Sequence[str],
    peers: Sequence[str],
    clock: str = "cpu",
    end: str = "",
    words: str = "",
) -> None:
    """
    :param report: what is found goes there
    :param samples: measurements, by key
    :param names: by key
    :param ours: keys of ours, of which some may be missing
    :param peers: keys of the others, of which some may be missing
    :param clock: ``"cpu"`` or ``"wall"``
    :param end: of the keys of these ratios; with one, only those to the best peer are added
    :param words: about all of them
    """
    rivals = {key: statistics.median(speeds(samples[key], clock)) for key in peers if key in samples}
    for key in [key for key in ours if key in samples and rivals]:
        for rank, rival in enumerate(sorted(rivals, key=lambda rival: -rivals[rival])):
            found, text = ratio(samples[key], samples[rival], clock), f"{names[key]} / {names[rival]}{words}"
            if rank == 0:
                report.add_ratio(f"{key}_vs_best_peer{end}", found, text)
            if not end:
                report.add_ratio(f"{key}_vs_{rival}", found, text)


def peer(name: str, library: str, *arguments: str) -> Program:
    """
    :param name: of what is measured
    :param library: whose environment and program it is
    :param arguments: of the program
    :return: the program
    """
    program = Program(name, [str(VENVS / library / "bin" / "python"), "-m", f"benchmarks.peers.{library}", *arguments])
    if not (VENVS / library / ".installed").exists():
        log = VENVS / f"{library}.log"
        lines = log.read_text().strip().splitlines() if log.exists() else []
        program.error = "not installed" + (f": {lines[-1]}" if lines else ", see make bench-peers")
    return program


def our(name: str, *arguments: str) -> Program:
    """
    :param name: of what is measured
    :param arguments: of the program
    :return: the program
    """
    return Program(name, [sys.executable, "-m", "benchmarks.peers.ours", *arguments])


def main(arguments: list[str] | None = None) -> None:
    """
    Measure, print and write.

    :param arguments: of the command line
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--peers", nargs="+", choices=PEERS, default=list(PEERS), metavar="PEER", help="of " + ", ".join(PEERS)
    )
    parser.add_argument("--rounds", type=int, default=None, help="measurements of each (default 7; 1 if quick)")
    parser.add_argument("--quick", action="store_true", help="everything tiny, to see that it runs: the numbers mean nothing")
    parser.add_argument("--out", type=Path, default=OUT, help="the JSON file")
    args = parser.parse_args(arguments)
    quick = ["--quick"] * args.quick
    report = PeerReport(args.rounds or (1 if args.quick else 7), args.quick, ratios={})
    report.title("peers", "three learners on simple_spread, with other libraries")
    ours = {key: our(*words, *quick) for key, words in OURS.items()}
    peers = {key: peer(*PEERS[key], *quick) for key in dict.fromkeys(args.peers)}
    compare(report, ours, peers, our("environments alone", "env", *quick))
    report.write(args.out)


if __name__ == "__main__":
    main()
