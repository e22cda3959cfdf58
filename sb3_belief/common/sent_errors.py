"""Exceptions on their way from a worker process to the main process."""

import pickle
import traceback
from contextlib import suppress
from typing import NamedTuple

import cloudpickle


class SentError(NamedTuple):
    """
    An exception as it travels.

    :param pickled: The exception; None if it cannot be pickled and rebuilt
    :param kind: Name of its class
    :param message: Its message
    :param notes: Its notes
    :param traceback: Its traceback, as text
    """

    pickled: bytes | None
    kind: str
    message: str
    notes: list[str]
    traceback: str


class _WorkerTraceback(Exception):
    # As concurrent.futures shows where it happened
    def __str__(self) -> str:
        return f'\n"""\n{self.args[0]}"""'


def sent_error(error: BaseException) -> SentError:
    """
    Pack an exception so that it can be sent.

    :param error: The exception
    :return: What :func:`rebuilt_error` makes it of again
    """
    message, pickled = _message(error), None
    with suppress(Exception):
        # cloudpickle also takes classes of the user's script
        pickled = cloudpickle.dumps(error)
        again = pickle.loads(pickled)
        if type(again) is not type(error) or _message(again) != message:
            pickled = None
    try:
        text = "".join(traceback.format_exception(type(error), error, error.__traceback__))
    except Exception:
        text = "".join(traceback.format_tb(error.__traceback__))
    return SentError(pickled, type(error).__name__, message, [*getattr(error, "__notes__", [])], text)


def rebuilt_error(sent: SentError) -> BaseException:
    """
    Return an exception of a worker, with the traceback there as its cause.

    :param sent: As it was sent
    :return: The same type with the same message and notes, or a ``RuntimeError`` that names both if it cannot be rebuilt
    """
    error = None
    if sent.pickled is not None:
        with suppress(Exception):
            error = pickle.loads(sent.pickled)
    if not isinstance(error, BaseException):
        error = RuntimeError(f"{sent.kind}: {sent.message}" if sent.message else sent.kind)
    if sent.notes:
        error.__notes__ = list(sent.notes)
    error.__cause__ = _WorkerTraceback(sent.traceback)
    return error


def _message(error: BaseException) -> str:
    try:
        return str(error)
    except Exception:
        return ""
