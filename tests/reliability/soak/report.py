"""What a soak counts, and the table of it."""

import json
import os
import platform
import re
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

BEGIN, END = "<!-- The soak writes what follows -->", "<!-- up to here -->"


@dataclass
class Report:
    """
    Counts of a soak.

    :param seed: Its seed
    :param minutes: How long it ran
    :param faults: How often each kind of fault was injected
    :param checks: How often each invariant was checked
    :param violations: What did not hold
    :param notes: How often something happened that is no fault of ours, such as a fault that came too late
    :param runs: Number of runs
    :param memory: See ``memory.growth``
    """

    seed: int
    minutes: float = 0.0
    faults: Counter = field(default_factory=Counter)
    checks: Counter = field(default_factory=Counter)
    violations: list[str] = field(default_factory=list)
    notes: Counter = field(default_factory=Counter)
    runs: int = 0
    memory: dict[str, float] = field(default_factory=dict)

    def check(self, invariant: str, holds: Any, detail: str) -> bool:
        """Count that an invariant was checked, and note it if it does not hold."""
        self.checks[invariant] += 1
        if not holds:
            self.violations.append(f"{invariant}: {detail}")
            print(f"VIOLATION: {invariant}: {detail}", flush=True)
        return bool(holds)

    def summary(self) -> str:
        """Return the totals, on a line."""
        counts = (self.runs, sum(self.faults.values()), sum(self.checks.values()), len(self.violations))
        return "{} runs, {} faults, {:,} checks, {} violations".format(*counts)

    def to_json(self) -> str:
        """Return everything as JSON."""
        return json.dumps(vars(self), indent=2)

    def to_markdown(self) -> str:
        """Return the tables."""
        lines = [
            f"{self.minutes:.0f} minutes with seed {self.seed} on {platform.system()}, {os.cpu_count()} cores, Python"
            f" {platform.python_version()}: {self.summary()}.",
            "",
            "| fault | times |",
            "|---|---|",
            *(f"| {name} | {count} |" for name, count in sorted(self.faults.items())),
            "",
            "| invariant | checked | violated |",
            "|---|---|---|",
        ]
        for name, count in sorted(self.checks.items()):
            violated = sum(text.startswith(f"{name}: ") for text in self.violations)
            lines.append(f"| {name} | {count} | {violated} |")
        if self.memory:
            lines += [
                "",
                "Memory of a training that ran alongside: {first:.0f} MiB after {after:.0f} minutes, {last:.0f} MiB at the end"
                " ({growth:+.1%}; at most +5 %), over {steps:,.0f} joint steps.".format(**self.memory),
            ]
        return "\n".join(lines) + "\n"

    def write_into(self, page: Path) -> None:
        """
        Put the tables into a page, between its two marks.

        :param page: A Markdown file that has them
        :raises ValueError: If it does not
        """
        text = page.read_text(encoding="utf-8")
        changed, count = re.subn(
            f"{re.escape(BEGIN)}.*?{re.escape(END)}",
            lambda _: f"{BEGIN}\n\n{self.to_markdown()}\n{END}",
            text,
            flags=re.DOTALL,
        )
        if count != 1:
            raise ValueError(f"{page} must have the lines {BEGIN!r} and {END!r} once each, with the tables between them.")
        page.write_text(changed, encoding="utf-8")
