"""Kills of a run at drawn moments, until it has finished."""

import contextlib
import random
import shutil
import signal
import time
from pathlib import Path

from sb3_belief.team.checkpoints import checkpoint_files
from tests.reliability.combinations import Combination
from tests.reliability.processes import Launcher, Training, wait_for
from tests.zoo.runs import record_of

PATIENCE = 240.0


def run_in(folder: Path) -> Path | None:
    """Return the folder of the run below a log folder; None if there is none yet."""
    try:
        found = list(folder.glob("*/*/run.json"))
    except FileNotFoundError:
        # A run that is interrupted before it has begun removes its folder
        return None
    return found[0].parent if found else None


def has_checkpoint(folder: Path) -> bool | None:
    """Return True once the run below a log folder has a checkpoint, otherwise None."""
    return any(folder.glob("*/*/checkpoints/*.zip")) or None


def undisturbed(launcher: Launcher, combination: Combination, folder: Path, seed: int) -> tuple[Path, float]:
    """Train without a fault, and return the run and how many seconds it took after its first checkpoint."""
    training = launcher.start(combination.command(folder, seed))
    wait_for(lambda: has_checkpoint(folder) or (None if training.poll() is None else True), PATIENCE)
    start = time.monotonic()
    status = training.wait(PATIENCE)
    seconds = time.monotonic() - start
    assert status == 0, training.output
    assert training.has_left_none()
    run = run_in(folder)
    assert run is not None
    return run, seconds


def has_begun(training: Training, folder: Path) -> bool | None:
    """Return True once a process has a checkpoint and holds its run's folder, or has ended, otherwise None."""
    if training.poll() is not None:
        return True
    if (run := run_in(folder)) is None or not has_checkpoint(folder):
        return None
    with contextlib.suppress(FileNotFoundError):
        if f"process {training.pid} " in (run / ".lock").read_text():
            return True
    return None


class Killed:
    """
    A run that is killed.

    :param launcher: Starts its processes
    :param combination: Its kind
    :param folder: Its log folder
    :param seed: Its seed
    :param seconds: How long its undisturbed twin took after its first checkpoint
    """

    def __init__(self, launcher: Launcher, combination: Combination, folder: Path, seed: int, seconds: float):
        self._launcher, self._combination, self._folder, self._seed = launcher, combination, folder, seed
        self._seconds = seconds
        self._copy = folder.with_name(f"{folder.name}_before")

    @property
    def run(self) -> Path:
        """The run's folder."""
        found = run_in(self._folder)
        assert found is not None
        return found

    @property
    def steps(self) -> int:
        """Joint steps at its newest checkpoint."""
        run = run_in(self._folder)
        files = [] if run is None else checkpoint_files(run / "checkpoints")
        return files[-1][0] if files else 0

    def start(self, anew: bool = False) -> Training:
        """Begin the run, or go on with it."""
        if has_checkpoint(self._folder):
            words = ["train", "--resume", str(self.run), "--verbose", "0", *self._combination.allowed]
        else:
            shutil.rmtree(self._folder, ignore_errors=True)
            words = self._combination.command(self._folder, self._seed)
        return self._launcher.start(words, anew)

    def kill(self, share: float, while_saving: bool = False, anew: bool = False) -> None:
        """
        Begin or go on, and kill. If it has finished before, it is tried again from where it was, earlier.

        :param share: When: share of what remains
        :param while_saving: Whether to kill when the next temporary file is written after that
        :param anew: See ``Launcher.start``
        """
        shutil.rmtree(self._copy, ignore_errors=True)
        if self._folder.exists():
            shutil.copytree(self._folder, self._copy)
        while True:
            training = self.start(anew)
            if self._wait_and_kill(training, share * self._seconds * (1 - self.steps / self._combination.total), while_saving):
                assert training.has_left_none(), f"left behind by a kill: {training.descendants()}"
                assert record_of(self.run)["status"] == "running"
                return
            share, while_saving = share / 2, while_saving and share > 0.01
            shutil.rmtree(self._folder, ignore_errors=True)
            if self._copy.exists():
                shutil.copytree(self._copy, self._folder)

    def _wait_and_kill(self, training: Training, seconds: float, while_saving: bool) -> bool:
        """Return whether it has been killed before it ended by itself."""
        assert wait_for(lambda: has_begun(training, self._folder), PATIENCE), training.output
        moment = time.monotonic() + seconds
        while training.poll() is None and time.monotonic() < moment:
            time.sleep(0.001)
        if while_saving:
            while training.poll() is None and not any(self.run.glob("checkpoints/.*.tmp")):
                time.sleep(0.0005)
        if training.poll() is not None:
            assert training.poll() == 0, training.output
            return False
        training.send(signal.SIGKILL)
        status = training.wait(20)
        assert status in (0, -signal.SIGKILL), f"{status}: {training.output}"
        return status != 0

    def finish(self) -> None:
        """Go on to the end."""
        training = self.start()
        status = training.wait(PATIENCE)
        assert status == 0, training.output
        assert training.has_left_none()


def drawn_kills(rng: random.Random, count: int) -> list[tuple[float, bool]]:
    """Draw kills: a share of what remains, and whether to wait for the next save from there."""
    return [(rng.uniform(0.0, 0.7), rng.random() < 0.3) for _ in range(count)]
