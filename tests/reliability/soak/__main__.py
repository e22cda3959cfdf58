"""
Disturb random trainings for as long as wanted, and check that nothing is lost.

    make soak
    make soak SOAK_MINUTES=20 SOAK_SEED=3

The exit status is 1 if an invariant did not hold.
"""

import argparse
import contextlib
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from sb3_belief.team import Team
from tests.reliability.processes import Launcher
from tests.reliability.soak.memory import LongTraining
from tests.reliability.soak.report import Report
from tests.reliability.soak.runs import Soak

_DISK_SIZE = "24m"
# A socket's path has at most 107 bytes (unix(7)), of which multiprocessing's names take 34
_LONGEST_PATH = 70


@contextlib.contextmanager
def small_disk(folder: Path) -> Iterator[Path | None]:
    """Mount a small file system, where that is permitted."""
    folder.mkdir()
    try:
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={_DISK_SIZE}", "tmpfs", folder], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        yield None
        return
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", folder], check=False)


def soak(minutes: float, seed: int, folder: Path) -> Report:
    """
    Disturb trainings.

    :param minutes: For how long
    :param seed: Seed of everything that is drawn
    :param folder: A new folder for all that is written
    :return: What was found
    :raises ValueError: If its path is too long for the sockets of processes that fork workers
    """
    report = Report(seed)
    start = time.monotonic()
    temporary = folder / "tmp"
    if len(os.fsencode(temporary.absolute())) > _LONGEST_PATH:
        raise ValueError(
            f"{temporary.absolute()} has more than {_LONGEST_PATH} bytes, too many for a socket in it: take a shorter folder."
        )
    for path in (folder / "outputs", temporary):
        path.mkdir()
    launcher = Launcher(folder / "outputs", "tests.reliability.ordered_env", temporary=temporary)
    with small_disk(folder / "disk") as disk, contextlib.closing(launcher):
        if disk is None:
            report.notes["no small disk could be mounted"] += 1
        long = LongTraining(launcher, folder / "long")
        runs = Soak(launcher, folder, disk, random.Random(seed), report)
        try:
            while time.monotonic() - start < 60 * minutes:
                runs.run_one()
                long.sample()
                report.minutes = (time.monotonic() - start) / 60
                print(f"{report.minutes:5.1f} min: {report.summary()}", flush=True)
        finally:
            long.end(report)
    check_temporary_files(temporary, folder / "outputs", report)
    return report


def check_temporary_files(temporary: Path, outputs: Path, report: Report) -> None:
    """
    Check that in the folder for temporary files nothing is left but teams that found no other place, and that they load.

    :param temporary: The folder
    :param outputs: Folder of what trainings have printed, which names such teams
    :param report: Counts
    """
    said = "".join(path.read_text(errors="replace") for path in outputs.iterdir())
    left = []
    for path in temporary.iterdir():
        if f"saved as {path} instead" in said:
            loads = False
            with contextlib.suppress(Exception):
                # Perhaps one that had not learned yet
                loads = Team.load(path, device="cpu").num_timesteps >= 0
            report.check("the team loads", loads, f"{path}")
        # torch's own cache
        elif not path.name.startswith("torchinductor"):
            left.append(path.name)
    report.check("no temporary file is left", not left, f"{left}")


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0, help="how long")
    parser.add_argument("--seed", type=int, default=0, help="seed of all that is drawn")
    parser.add_argument("--folder", type=Path, help="new folder for the runs, which stays; if left out, a temporary one")
    parser.add_argument("--write", type=Path, metavar="PAGE", help="page into which the tables are written")
    args = parser.parse_args()
    folder = args.folder or Path(tempfile.mkdtemp(prefix="soak-"))
    folder.mkdir(exist_ok=True)
    report = soak(args.minutes, args.seed, folder)
    print(f"\n{report.to_markdown()}")
    for text in report.violations:
        print(f"VIOLATION: {text}")
    (folder / "soak.json").write_text(report.to_json())
    if args.write is not None:
        report.write_into(args.write)
    if args.folder is None and not report.violations:
        shutil.rmtree(folder)
    else:
        print(f"The runs are in {folder}")
    return 1 if report.violations else 0


if __name__ == "__main__":
    sys.exit(main())
