"""
What pytest loads into a run of a suite, with `-p tests.conformance.plugin`.

Our classes take their place before the suite's modules are imported. Of what these collect only the tests remain in which ours
take part. A test that is listed may fail; one that passes nevertheless is reported, and an entry about no test is an error.
"""

from collections import Counter
from pathlib import Path

import pytest
import torch as th

from tests.conformance.examined import EXAMINED, put_in_place
from tests.conformance.listed import matching, read_listed
from tests.conformance.selection import takes_part

LISTED = Path(__file__).with_name("listed.yml")


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("conformance")
    group.addoption("--suite", default="sb3", help="the suite's name in the list")
    group.addoption(
        "--belief", default="none", choices=list(EXAMINED), help="none: environments as they are; active: with others"
    )
    group.addoption("--listed", type=Path, default=LISTED, help="the list of tests that do not apply")
    group.addoption("--summary", type=Path, help="file to write the summary to as well")


def pytest_configure(config: pytest.Config) -> None:
    th.set_num_threads(1)  # as in our own tests: the networks are small
    config.pluginmanager.register(Exam(config, put_in_place(config.getoption("belief"))), "exam")


class Exam:
    """One run of one suite: which tests it consists of, and how they ended."""

    def __init__(self, config: pytest.Config, examined: list[type]) -> None:
        self.config = config
        self.examined = examined
        self.name = f"{config.getoption('suite')}, belief {config.getoption('belief')}"
        self.listed = read_listed(config.getoption("listed"), config.getoption("belief"), config.getoption("suite"))
        self.ended: dict[str, str] = {}
        self.reasons: dict[str, str] = {}

    # before `-k` and the like leave any out, so that these do not make entries look stale
    @pytest.hookimpl(tryfirst=True)
    def pytest_collection_modifyitems(self, session: pytest.Session, items: list[pytest.Item]) -> None:
        if session.testsfailed:  # a module could not be imported: pytest says so and ends
            return
        taking_part = [item for item in items if takes_part(item, self.examined)]
        self.config.hook.pytest_deselected(items=[item for item in items if item not in taking_part])
        items[:] = taking_part
        if not items:
            raise pytest.UsageError(f"{self.name}: no test takes part")
        by_name = {_name(item.nodeid): item for item in items}
        for pattern, reason in self.listed.items():
            about = matching(pattern, by_name)
            if not about:
                raise pytest.UsageError(f"{self.name}: listed, but no such test takes part: {pattern}")
            for name in about:
                by_name[name].add_marker(pytest.mark.xfail(reason=reason, strict=False))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        name = _name(report.nodeid)
        if report.failed:
            self.ended[name] = "failed"
        elif hasattr(report, "wasxfail"):
            self.ended[name] = "listed" if report.skipped else "listed, but passed"
            self.reasons[name] = report.wasxfail
        elif report.skipped:
            self.ended[name] = "skipped by the suite itself"
            self.reasons[name] = report.longrepr[-1] if isinstance(report.longrepr, tuple) else str(report.longrepr)
        elif report.when == "call":
            self.ended[name] = "passed"

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        counts = Counter(self.ended.values())
        lines = [f"{self.name}: {len(self.ended)} tests, " + ", ".join(f"{counts[kind]} {kind}" for kind in sorted(counts))]
        for name, kind in sorted(self.ended.items(), key=lambda item: item[::-1]):
            if kind != "passed":
                lines.append(f"  {kind}: {name}" + (f": {self.reasons[name]}" if name in self.reasons else ""))
        terminalreporter.section("conformance")
        for line in lines:
            terminalreporter.write_line(line)
        if summary := self.config.getoption("summary"):
            summary.write_text("\n".join(lines) + "\n")


def _name(nodeid: str) -> str:
    """A test's id without its folder."""
    path, _, test = nodeid.partition("::")
    return f"{Path(path).name}::{test}"
