"""
How fast are other libraries at the same task? Three independent PPOs with networks of their own on mpe2's simple_spread.

    make bench-peers
    make bench-peers BENCH_ARGS="--rounds 9 --peers rllib"

Every program trains on 8 copies x 128 steps, then 10 epochs of 4 minibatches, with 64x64 tanh networks for the policy and the
value, with one thread of torch on the CPU. Each program is a process in the environment of its library (see the files of this
folder: they say where a library differs, and ``<library>.txt`` has its pins). All programs are started, and warmed up by one
iteration, before any is measured. Then they take turns, one iteration each, back and forth, and only one works at a time.

Speeds are joint steps (of one copy) per CPU second, of the program and all processes that it started, and per second of
wall-clock time. The work of the first iteration is counted: steps of the environments and of the optimisers, and the
parameters that these changed. The best peer is the fastest program of another library, even with a loop of ours. The
environments alone are measured, too, since no program can be faster. A library that cannot be installed, or that fails, is
skipped, and the report says why.
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
#: By key of their ratios: name, library, further arguments of the program
PEERS = {
    "rllib": ("RLlib", "rllib"),
    "agilerl": ("AgileRL, copies in a loop of ours", "agilerl"),
    "agilerl_processes": ("AgileRL, copies in its processes", "agilerl", "--processes"),
    "benchmarl": ("BenchMARL", "benchmarl"),
}


class PeerReport(Report):
    """Report of the comparison, printed as ``make bench`` does."""

    bars = MappingProxyType({"ippo_vs_best_peer": (">=", 2.0), "ppo_vs_best_peer": (">=", 2.0)})

    def add_programs(self, programs: Mapping[str, Program]) -> None:
        """Add programs that were measured, by key."""
        self.add_samples("peers", {program.name: program.samples for program in programs.values()}, "joint steps")
        print("  work of the first iteration; CPU time while others work:")
        for key, program in programs.items():
            self.time[key] = {**program.about, "idle_share_of_a_core": program.idle_share}
            work = ", ".join(f"{number:,} {what.replace('_', ' ')}" for what, number in program.about.get("work", {}).items())
            print(f"  {program.name}: {work}; {program.idle_share:.1%} of a core")

    def add_ratio(self, key: str, found: Spread, text: str) -> None:
        super().add_ratio(key, found, text)
        # Also those without a bar, since the best library may be another one next time
        self.ratios[key] = found.median

    def write(self, path: Path) -> None:
        details = {"rounds": self.rounds, "quick": self.quick, "rows": self.rows, "ratios": self.ratio_rows}
        found = {"programs": self.time, "skipped": self.skipped, "details": details}
        write_json({"ratios": self.ratios, "versions": versions(), **found}, path)


def compare(report: PeerReport, ours: Mapping[str, Program], peers: Mapping[str, Program], env: Program) -> None:
    """
    Start all programs, measure those that work in turns, and stop them.

    :param report: Receives the results
    :param ours: Our programs, by key
    :param peers: The programs of other libraries, by key
    :param env: The environments alone
    """
    programs = {**ours, **peers, "env": env}
    try:
        for program in programs.values():
            program.start()
        # A program that fails in the middle does nothing in later turns
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
    for clock in ("cpu", "wall"):
        add_ratios(report, samples, names, list(ours), list(peers), clock)


def add_ratios(
    report: PeerReport,
    samples: Mapping[str, Sequence[Sample]],
    names: Mapping[str, str],
    ours: Sequence[str],
    peers: Sequence[str],
    clock: str,
) -> None:
    """
    Add the ratio of each of our programs to the best peer and, of CPU time, to each other one.

    :param report: Receives the ratios
    :param samples: Measurements, by key
    :param names: Names of the programs, by key
    :param ours: Keys of our programs, some of which may be missing
    :param peers: Keys of the peers, some of which may be missing
    :param clock: ``"cpu"`` or ``"wall"``
    """
    rivals = {key: statistics.median(speeds(samples[key], clock)) for key in peers if key in samples}
    end, words = ("_wall", ", wall-clock time") if clock == "wall" else ("", "")
    for key in [key for key in ours if key in samples and rivals]:
        for rank, rival in enumerate(sorted(rivals, key=lambda rival: -rivals[rival])):
            found, text = ratio(samples[key], samples[rival], clock), f"{names[key]} / {names[rival]}{words}"
            if rank == 0:
                report.add_ratio(f"{key}_vs_best_peer{end}", found, text)
            if clock == "cpu":
                report.add_ratio(f"{key}_vs_{rival}", found, text)


def peer(name: str, library: str, *arguments: str) -> Program:
    """Return a program of another library, which runs in the environment of this library."""
    program = Program(name, [str(VENVS / library / "bin" / "python"), "-m", f"benchmarks.peers.{library}", *arguments])
    if not (VENVS / library / ".installed").exists():
        log = VENVS / f"{library}.log"
        lines = log.read_text().strip().splitlines() if log.exists() else []
        program.error = "not installed" + (f": {lines[-1]}" if lines else ", see make bench-peers")
    return program


def our(name: str, *arguments: str) -> Program:
    """Return a program of ours."""
    return Program(name, [sys.executable, "-m", "benchmarks.peers.ours", *arguments])


def main(arguments: list[str] | None = None) -> None:
    """
    Measure, print and write.

    :param arguments: Arguments of the command line
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--peers", nargs="+", choices=PEERS, default=list(PEERS), metavar="PEER", help="some of " + ", ".join(PEERS)
    )
    parser.add_argument("--rounds", type=int, default=None, help="measurements of each program (default 7; 1 with --quick)")
    parser.add_argument("--quick", action="store_true", help="make everything tiny, as a test: the numbers mean nothing")
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
