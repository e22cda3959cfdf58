"""What is done to a training, and how it may end then."""

import os
import random
import signal
import time
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sb3_belief.team.checkpoints import checkpoint_files
from tests.reliability.processes import Training, wait_for

KILL = -int(signal.SIGKILL)


@dataclass(frozen=True)
class Fault:
    """
    A kind of fault.

    :param name: Its name in the table
    :param inject: Does it to a training, in a folder; returns False if the training had ended
    :param statuses: Exit statuses that it may lead to, beside 0 if the training had all but ended
    :param record: The status in ``run.json`` then
    :param cuts: Whether an episode is cut, so that the run differs from its undisturbed twin
    """

    name: str
    inject: Callable[[Training, Path], bool]
    statuses: frozenset[int]
    record: str
    cuts: bool = False


def _times(signum: int, times: int) -> Callable[[Training, Path], bool]:
    def send(training: Training, run: Path) -> bool:
        # To the group, as a terminal or a scheduler does
        sent = training.send(signum)
        for _ in range(times - 1):
            time.sleep(0.05)
            training.send(signum)
        return sent

    return send


def _kill_while_saving(training: Training, run: Path) -> bool:
    while training.poll() is None and not any(run.glob("checkpoints/.*.tmp")):
        time.sleep(0.0005)
    return training.send(signal.SIGKILL)


def signals() -> list[Fault]:
    """Return all faults by signals to the training."""
    found = [
        Fault("SIGKILL", _times(signal.SIGKILL, 1), frozenset({KILL}), "running"),
        Fault("SIGKILL while a checkpoint is written", _kill_while_saving, frozenset({KILL}), "running"),
    ]
    for signum in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        for times, text in ((1, ""), (2, ", twice within 50 ms"), (3, ", three times within 100 ms")):
            statuses = frozenset({128 + int(signum)})
            found.append(Fault(f"{signum.name}{text}", _times(signum, times), statuses, "interrupted"))
    return found


def _kill_worker(rng: random.Random) -> Callable[[Training, Path], bool]:
    def inject(training: Training, _: Path) -> bool:
        workers = wait_for(lambda: sorted(training.workers()) or (None if training.poll() is None else []), 20)
        if not workers:
            return False
        try:
            os.kill(rng.choice(workers), signal.SIGKILL)
        except ProcessLookupError:
            return False
        return True

    return inject


def death_of_a_worker(rng: random.Random, what: str) -> Fault:
    """Return the fault that a worker is killed."""
    return Fault(f"death of {what}", _kill_worker(rng), frozenset({1}), "failed")


def ordered(order: str, orders: Path, text: str, restarts: bool) -> Fault:
    """
    Return a fault of ``OrderedEnv``.

    :param order: What it does
    :param orders: The file that it looks for
    :param text: Name of the fault
    :param restarts: Whether its worker is restarted
    """

    def inject(training: Training, _: Path) -> bool:
        orders.write_text(order)
        if wait_for(lambda: (not orders.exists() or training.poll() is not None) or None, 60) is None:
            return False
        taken = not orders.exists()
        orders.unlink(missing_ok=True)
        return taken

    if restarts:
        return Fault(f"{text}, restarted", inject, frozenset({0}), "finished", cuts=True)
    return Fault(text, inject, frozenset({1}), "failed")


def full_disk(folder: Path, rng: random.Random) -> Fault:
    """
    Return the fault that the disk of a folder is full, but for some kilobytes, until the training has ended.

    :param folder: A folder on a small file system of its own
    """

    def inject(training: Training, _: Path) -> bool:
        with open(folder / "filler", "wb", buffering=0) as file:
            try:
                while training.poll() is None:
                    file.write(bytes(4096))
            except OSError:
                pass
        if rng.random() < 0.5:
            # Room for tables, but not for teams
            os.truncate(folder / "filler", max(0, (folder / "filler").stat().st_size - 8192))
        return training.poll() is None

    return Fault("full disk (tmpfs)", inject, frozenset({1}), "failed")


def damage_newest(checkpoints: Path, rng: random.Random) -> tuple[str, Path] | None:
    """
    Cut the newest checkpoint, or flip a bit of what it holds.

    :return: What was done, and the file; None if there is no older one
    """
    files = checkpoint_files(checkpoints)
    if len(files) < 2:
        return None
    path = files[-1][1]
    if not zipfile.is_zipfile(path):
        # Damaged already
        return None
    content = bytearray(path.read_bytes())
    kind = rng.choice(["truncated checkpoint", "bit-flipped checkpoint"])
    if kind == "truncated checkpoint":
        content = content[: rng.randrange(len(content))]
    else:
        # Not of what nobody reads, such as the date of a member
        with zipfile.ZipFile(path) as archive:
            members = [each for each in archive.infolist() if each.compress_size > 0]
        member = rng.choices(members, [each.compress_size for each in members])[0]
        header = member.header_offset
        # Its fixed part, and the lengths of name and further fields
        start = header + 30 + sum(int.from_bytes(content[header + at : header + at + 2], "little") for at in (26, 28))
        content[start + rng.randrange(member.compress_size)] ^= 1 << rng.randrange(8)
    path.write_bytes(content)
    return kind, path
