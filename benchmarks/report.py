"""The report of a benchmark: printed as results come in, and written as JSON at the end."""

import json
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar

from benchmarks.measure import Loop, Sample, Spread, alternate, cores, speeds, spread
from sb3_belief.common import versions as package

#: The aim of each ratio: at least, or at most, this number
BARS: dict[str, tuple[str, float]] = {
    "lockstep_vs_hand": (">=", 0.97),
    "ippo_vs_hand": (">=", 1.25),
    "belief_vs_ippo_spread": (">=", 0.5),
    "belief_vs_ippo_junction": (">=", 0.35),
    "agents_20_vs_5": ("<=", 1.1),
    "others_40_vs_5": ("<=", 1.5),
    "history_6400_vs_800": ("<=", 4.0),
    "two_cores_vs_one": (">=", 1.5),
    "workers_vs_ideal": (">=", 0.85),
    "checks_dqn": ("<=", 1.03),
    "checks_sac": ("<=", 1.02),
    "checks_ppo": ("<=", 1.02),
    "checkpoints_vs_none": (">=", 0.97),
    "scripted_vs_callables": (">=", 10.0),
    "seconds_of_a_checkpoint": ("<", 0.5),
    "pool_vs_one_team": (">=", 0.5),
    "pool_per_copy_vs_one_team": (">=", 0.5),
    "partners_vs_agent_env": (">=", 10.0),
    "adaptive_vs_dynamic": (">=", 0.75),
    "adaptive_vs_ippo": (">=", 0.5),
}
#: The same of peak memory, in MiB
PEAK_BARS: dict[str, tuple[str, float]] = {"junction belief_ppo": ("<", 1536.0)}
_HOLDS = {">=": float.__ge__, "<=": float.__le__, "<": float.__lt__}


def _judge(value: float, bar: tuple[str, float] | None) -> str:
    if bar is None:
        return ""
    sign, number = bar
    return f"   bar {sign} {number:g}: {'met' if _HOLDS[sign](float(value), number) else 'missed'}"


@dataclass
class Report:
    """
    Report of what was measured.

    :param rounds: Number of measurements of each loop
    :param quick: Whether everything is tiny. Then the numbers mean nothing
    """

    #: Aims by key of a ratio, see ``BARS``
    bars: ClassVar[Mapping[str, tuple[str, float]]] = BARS

    rounds: int
    quick: bool
    rows: list[dict[str, Any]] = field(default_factory=list)
    ratios: dict[str, float | None] = field(default_factory=lambda: dict.fromkeys(BARS))
    ratio_rows: dict[str, dict[str, Any]] = field(default_factory=dict)
    peak_mib: dict[str, float] = field(default_factory=dict)
    time: dict[str, Any] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)

    def title(self, part: str, text: str) -> None:
        """Print the heading of a part: its name, and what it measures."""
        print(f"\n{part}: {text}", flush=True)

    def measure(
        self, part: str, loops: Mapping[str, Loop], unit: str = "joint steps", warmup: int = 1
    ) -> dict[str, list[Sample]]:
        """
        Measure loops in turns and add their speeds.

        :param part: Part of the benchmark
        :param loops: The loops to compare, by name
        :param unit: Kind of steps that they count
        :param warmup: Number of calls of each loop beforehand that are not measured; none in a quick run
        :return: The measurements of each loop, one per round
        """
        samples = alternate(loops, self.rounds, 0 if self.quick else warmup)
        self.add_samples(part, samples, unit)
        return samples

    def add_samples(self, part: str, samples: Mapping[str, Sequence[Sample]], unit: str) -> None:
        """
        Add speeds.

        :param part: Part of the benchmark
        :param samples: Measurements, by name
        :param unit: Kind of steps that they count
        """
        width = max(map(len, samples))
        print(f"  {'':{width}s} {unit + ' per CPU second':>30s} {'per wall second':>30s}   (quartiles)")
        for name, measured in samples.items():
            row: dict[str, Any] = {"part": part, "name": name, "unit": unit, "steps": [sample.steps for sample in measured]}
            texts = []
            for clock in ("cpu", "wall"):
                found = spread(speeds(measured, clock))
                row[f"per_{clock}_second"] = found._asdict()
                texts.append(f"{found.median:9,.0f} ({found.low:,.0f} to {found.high:,.0f})")
            self.rows.append(row)
            print(f"  {name:{width}s} {texts[0]:>30s} {texts[1]:>30s}", flush=True)

    def add_ratio(self, key: str, found: Spread, text: str) -> None:
        """
        Add a ratio, and judge it where it has a bar.

        :param key: Key of ``bars``, or another one for a detail without a bar
        :param found: The ratio and its quartiles
        :param text: What is divided by what
        """
        bar = self.bars.get(key)
        if bar is not None:
            self.ratios[key] = found.median
        self.ratio_rows[key] = {**found._asdict(), "text": text, "bar": None if bar is None else f"{bar[0]} {bar[1]:g}"}
        print(
            f"  {key}: {text}: {found.median:.3f} ({found.low:.3f} to {found.high:.3f}){_judge(found.median, bar)}", flush=True
        )

    def add_phases(self, part: str, milliseconds: Mapping[str, Mapping[str, float]]) -> None:
        """
        Add where the time goes, as ``time[part]``.

        :param part: Part of the benchmark
        :param milliseconds: CPU milliseconds per joint step of each phase and of all together (``"total"``), by algorithm
        """
        updates = {algo: phases["update"] for algo, phases in milliseconds.items()}
        # The belief's backward pass is one with that of the policy: its share is what an update takes longer than without it
        share = 1 - updates["ippo"] / updates["belief_ppo"]
        self.time[part] = {"ms_per_joint_step": milliseconds, "belief_share_of_update": share}
        print("  where the time goes, CPU ms per joint step (share):")
        print("  " + " " * 12 + "".join(f"{algo:>18s}" for algo in milliseconds))
        for phase in milliseconds["ippo"]:
            cells = [f"{phases[phase]:.3f} ({phases[phase] / phases['total']:4.0%})" for phases in milliseconds.values()]
            print(f"  {phase:12s}" + "".join(f"{cell:>18s}" for cell in cells))
        print(f"  the belief's share of the update: {share:.0%} (what it takes longer than that of ippo)", flush=True)

    def add_peak(self, name: str, mib: float) -> None:
        """Add the peak memory of a program, in MiB."""
        self.peak_mib[name] = mib
        print(f"  {name}: {mib:,.0f} MiB{_judge(mib, PEAK_BARS.get(name))}", flush=True)

    def skip(self, name: str, reason: str) -> None:
        """Note that something is not measured, and why."""
        self.skipped[name] = reason
        print(f"  {name}: skipped: {reason}", flush=True)

    def write(self, path: Path) -> None:
        """Write everything to a JSON file."""
        details = {
            "rounds": self.rounds,
            "quick": self.quick,
            "rows": self.rows,
            "ratios": self.ratio_rows,
            "time": self.time,
            "skipped": self.skipped,
        }
        content = {"ratios": self.ratios, "peak_mib": self.peak_mib, "versions": versions(), "details": details}
        write_json(content, path)


def write_json(content: Mapping[str, Any], path: Path) -> None:
    """Write a JSON file, and make its folder if that is missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=2) + "\n")
    print(f"\nwritten: {path}")


def versions() -> dict[str, Any]:
    """Return the versions of the packages that were measured, and what the machine is."""
    found: dict[str, Any] = {**package.versions(), "system": platform.platform(), "cores": cores()}
    found["processor"] = _processor()
    # On a machine that is busy with other work only the ratios mean something
    found["load"] = list(os.getloadavg()) if hasattr(os, "getloadavg") else None
    # SMAX is measured in an environment without mpe2
    found["mpe2"] = metadata.version("mpe2") if find_spec("mpe2") else None
    return found


def _processor() -> str:
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()
