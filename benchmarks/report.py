"""What the benchmarks found: printed as it comes, and written as JSON at the end."""

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

#: What each ratio should be: at least (or at most, or less than) the number
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
}
#: MiB
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
    :param rounds: measurements of each loop
    :param quick: whether all was made tiny: then the numbers mean nothing
    """

    #: By key of a ratio, see ``BARS``
    bars: ClassVar[Mapping[str, tuple[str, float]]] = BARS

    rounds: int
    quick: bool
    rows: list[dict[str, Any]] = field(default_factory=list)
    ratios: dict[str, float | None] = field(default_factory=lambda: dict.fromkeys(BARS))
    ratio_rows: dict[str, dict[str, Any]] = field(default_factory=dict)
    peak_mib: dict[str, float | None] = field(default_factory=dict)
    time: dict[str, Any] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)

    def title(self, part: str, text: str) -> None:
        """
        :param part: its name
        :param text: what it measures
        """
        print(f"\n{part}: {text}", flush=True)

    def measure(
        self, part: str, loops: Mapping[str, Loop], unit: str = "joint steps", warmup: int = 1
    ) -> dict[str, list[Sample]]:
        """
        :param part: of the benchmark
        :param loops: what to compare, by name
        :param unit: what steps they count
        :param warmup: runs of each beforehand that do not count
        :return: the measurements of each, round by round
        """
        samples = alternate(loops, self.rounds, 0 if self.quick else warmup)
        self.add_samples(part, samples, unit)
        return samples

    def add_samples(self, part: str, samples: Mapping[str, Sequence[Sample]], unit: str) -> None:
        """
        :param part: of the benchmark
        :param samples: measurements, by name
        :param unit: what steps they count
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
        :param key: of ``bars``, or another: then it has no bar and is a detail
        :param found: the ratio and its spread
        :param text: what is divided by what
        """
        bar = self.bars.get(key)
        if bar is not None:
            self.ratios[key] = found.median
        self.ratio_rows[key] = {**found._asdict(), "text": text, "bar": None if bar is None else f"{bar[0]} {bar[1]:g}"}
        print(
            f"  {key}: {text}: {found.median:.3f} ({found.low:.3f} to {found.high:.3f}){_judge(found.median, bar)}", flush=True
        )

    def add_peak(self, name: str, mib: float | None) -> None:
        """
        :param name: of the program whose memory it is
        :param mib: its peak; None where the system does not tell
        """
        self.peak_mib[name] = mib
        text = "unknown" if mib is None else f"{mib:,.0f} MiB{_judge(mib, PEAK_BARS.get(name))}"
        print(f"  {name}: {text}", flush=True)

    def skip(self, name: str, reason: str) -> None:
        """
        :param name: of what is not measured
        :param reason: why
        """
        self.skipped[name] = reason
        print(f"  {name}: skipped: {reason}", flush=True)

    def write(self, path: Path) -> None:
        """
        :param path: of the JSON file
        """
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
    """
    :param content: of the file
    :param path: of the file, whose folder is made if it is missing
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=2) + "\n")
    print(f"\nwritten: {path}")


def versions() -> dict[str, Any]:
    """
    :return: what was measured with, and on
    """
    found: dict[str, Any] = {**package.versions(), "system": platform.platform(), "cores": cores()}
    found["processor"] = _processor()
    # What else ran: on a busy machine only the ratios mean something
    found["load"] = list(os.getloadavg()) if hasattr(os, "getloadavg") else None
    # Not where SMAX is measured
    found["mpe2"] = metadata.version("mpe2") if find_spec("mpe2") else None
    return found


def _processor() -> str:
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()
