"""
Is what we learn as good as what BenchMARL learns, of the same task in as many steps? Five algorithms on mpe2's simple_spread.

    python -m benchmarks.strength --jobs 2    # 30 trainings, 2 CPU hours; one that is done is not repeated

Each library trains in an environment of its own (``make .venv-peers/benchmarl/.installed`` makes BenchMARL's) with the
settings of ``benchmarks.peers.spread_settings``, and with its own in all else. Then 320 greedy episodes are played; the return
of an episode is the mean of the three agents'. The table has interquartile means over the seeds with their 95 % intervals.
MADDPG has velocities as actions, since BenchMARL's takes no others.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.peers.programs import ROOT
from benchmarks.peers.spread_settings import OFF_POLICY, ON_POLICY
from sb3_belief.report.statistics import estimate

OUT = ROOT / "benchmarks" / "out" / "strength"
#: By library: its Python, its module
LIBRARIES = {
    "ours": (Path(sys.executable), "benchmarks.peers.ours_strength"),
    "BenchMARL": (ROOT / ".venv-peers" / "benchmarl" / "bin" / "python", "benchmarks.peers.benchmarl_strength"),
}


def trained(library: str, algorithm: str, seed: int, steps: int, folder: Path) -> dict[str, Any]:
    """
    Train and play, or read what an earlier call has found.

    :param library: A key of ``LIBRARIES``
    :param algorithm: Name of the algorithm
    :param seed: Seed of the run
    :param steps: Joint steps of the training
    :param folder: Where results are kept
    :return: ``returns`` of the episodes, ``seconds`` of the CPU
    :raises RuntimeError: If the program fails
    """
    path = folder / f"{library}-{algorithm}-{steps}-{seed}.json"
    if not path.exists():
        python, module = LIBRARIES[library]
        words = [str(python), "-m", module, algorithm, "--seed", str(seed), "--steps", str(steps)]
        done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"{' '.join(words)} failed:\n{done.stderr[-2000:]}")
        folder.mkdir(parents=True, exist_ok=True)
        path.write_text(done.stdout.strip().splitlines()[-1])
        print(f"{library} {algorithm}, seed {seed}: {np.mean(json.loads(path.read_text())['returns']):.2f}", flush=True)
    return json.loads(path.read_text())


def table(found: Mapping[tuple[str, str], list[dict[str, Any]]]) -> str:
    """
    Return the table, as Markdown.

    :param found: {(algorithm, library): results by seed}
    """
    lines = [f"| | {' | '.join(LIBRARIES)} | CPU s a run |", "|---|---|---|---|"]
    for algorithm in dict.fromkeys(algorithm for algorithm, _ in found):
        cells, seconds = [], []
        for library in LIBRARIES:
            results = found[algorithm, library]
            score = estimate([np.array([np.mean(each["returns"]) for each in results])])
            interval = "" if score.low is None else f" ({score.low:.2f} to {score.high:.2f})"
            cells.append(f"{score.value:.2f}{interval}")
            seconds.append(f"{np.median([each['seconds'] for each in results]):.0f}")
        lines.append(f"| `{algorithm}` | {' | '.join(cells)} | {'; '.join(seconds)} |")
    return "\n".join(lines)


def main() -> None:
    """Train all, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algorithms", nargs="+", choices=(*ON_POLICY, *OFF_POLICY), default=[*ON_POLICY, *OFF_POLICY])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--folder", type=Path, default=OUT, help="where results are kept")
    args = parser.parse_args()
    if not LIBRARIES["BenchMARL"][0].exists():
        parser.error("BenchMARL has no environment yet: make .venv-peers/benchmarl/.installed")
    runs = [(algorithm, name, seed) for algorithm in args.algorithms for seed in range(args.seeds) for name in LIBRARIES]
    with ThreadPoolExecutor(args.jobs) as pool:
        results = list(pool.map(lambda run: trained(run[1], run[0], run[2], args.steps, args.folder), runs))
    found: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for (algorithm, name, _), result in zip(runs, results, strict=True):
        found.setdefault((algorithm, name), []).append(result)
    print(table(found))


if __name__ == "__main__":
    main()
