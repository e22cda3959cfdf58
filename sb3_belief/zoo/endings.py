"""How a training ends: by itself, by a signal, or by an error. Whatever it is, the last good state is saved and said."""

import os
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from sb3_belief.common.durable_files import replaced_file
from sb3_belief.zoo.errors import reason_of

#: Signals that end a training, as far as the system has them: Ctrl-C, a scheduler's request, a closed terminal
SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")
TRACEBACK = "error.txt"


class Interrupted(KeyboardInterrupt):
    """
    Raised in a training by a signal.

    :param signum: Number of the signal
    """

    def __init__(self, signum: int):
        super().__init__(signum)
        self.signum = signum

    @property
    def signal_name(self) -> str:
        """Name of the signal, such as SIGTERM."""
        return signal.Signals(self.signum).name

    @property
    def exit_status(self) -> int:
        """Exit status that a shell shows of a program that this signal has ended."""
        return 128 + self.signum


class EndSignals:
    """
    Context in which the first signal that asks the program to end raises ``Interrupted``, and the next ones wait for the save.

    A third signal ends the program at once. Only the main thread can handle signals: elsewhere nothing changes. A signal that
    is ignored when the context begins, as ``nohup`` has it, stays ignored.

    What the handler raises may arrive as another error: before Python 3.12, as a RuntimeError if it comes while a class is
    made, and PyTorch imports many of them when the first optimizer is made. An error after a signal thus counts as the signal.
    """

    def __init__(self) -> None:
        self._count = 0
        self._first: int | None = None
        self._raises = True
        self._before: dict[int, Any] = {}

    def __enter__(self) -> "EndSignals":
        if threading.current_thread() is threading.main_thread():
            for name in SIGNALS:
                number = getattr(signal, name, None)
                if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
                    self._before[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        for number, handler in self._before.items():
            # What was not set from Python is None
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        self._before = {}
        if error is not None and self._raises and (ended_by := self.cause_of(error)) is not error:
            raise ended_by from error

    def _handle(self, signum: int, _: FrameType | None) -> None:
        self._count += 1
        if self._count >= 3:
            os._exit(128 + signum)
        if self._count == 2 or not self._raises:
            tell("Saving. A further signal ends the program at once, without.")
        if self._first is None:
            self._first = signum
            self.check()

    def check(self) -> None:
        """
        Raise if there has been a signal, unless the program is saving.

        :raises Interrupted: If so. The handler raises it already, but what Python raises in a finaliser is lost
        """
        if self._first is not None and self._raises:
            raise Interrupted(self._first)

    def cause_of(self, error: BaseException) -> BaseException:
        """
        Return what has ended a training: the signal, if there has been one before the error, or else the error.

        :param error: What was raised
        """
        return error if self._first is None or isinstance(error, Interrupted) else Interrupted(self._first)

    def hold(self) -> None:
        """Raise nothing from now on: the program is saving, and ends then."""
        self._raises = False


class SignalCheck(BaseCallback):
    """
    Callback that ends the training at a signal, should the exception of its handler have been lost.

    :param signals: The signals
    """

    def __init__(self, signals: EndSignals):
        super().__init__()
        self._signals = signals

    def _on_step(self) -> bool:
        self._signals.check()
        return True


def write_traceback(folder: Path, error: BaseException) -> Path | None:
    """
    Write the traceback of an error into a run's folder.

    :param folder: The folder
    :param error: The error
    :return: The file; None if it could not be written
    """
    path = folder / TRACEBACK
    try:
        with replaced_file(path, "w", encoding="utf-8", errors="backslashreplace") as file:
            file.writelines(traceback.format_exception(error))
    except OSError:
        return None
    return path


def save_somewhere(path: Path, write: Callable[[Path], object]) -> Path | None:
    """
    Write a file to its place, or else to another one, which is said. There it takes no other file's place.

    :param path: The file, in the folder of a run
    :param write: Writes it to a path
    :return: Where it has been written; None if nowhere
    """
    run = path.parent
    elsewhere = f"{run.parent.name}_{run.name}_{path.name}"
    for place in (path, run.parent / elsewhere, Path(tempfile.gettempdir()) / elsewhere):
        try:
            if place == path:
                write(place)
                return place
            return _write_elsewhere(place, write)
        except OSError as error:
            tell(f"{place} could not be written ({reason_of(error)}).")
    return None


def _write_elsewhere(wanted: Path, write: Callable[[Path], object]) -> Path:
    """Write a file to a place where none is, since runs in several folders for logs have the same names."""
    place, number = wanted, 1
    while True:
        try:
            # Nobody else takes the name meanwhile
            place.touch(exist_ok=False)
            break
        except FileExistsError:
            number += 1
            place = wanted.with_stem(f"{wanted.stem}_{number}")
    try:
        write(place)
    except BaseException:
        place.unlink(missing_ok=True)
        raise
    tell(f"The team has been saved as {place} instead.")
    return place


def tell(text: str) -> None:
    """
    Write a line to the standard error.

    :param text: The line
    """
    # Not through print(), which must not be entered again by a signal's handler
    try:
        os.write(sys.__stderr__.fileno() if sys.__stderr__ is not None else 2, f"{text}\n".encode())
    except (OSError, ValueError):
        pass
