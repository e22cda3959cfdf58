"""Messages of exceptions, and notes on them, also for Python 3.10, which does not have these yet."""

import sys
import warnings


def first_line(error: BaseException) -> str:
    """
    Return the first line of an error's message, for a sentence that goes on after it.

    :param error: The error
    :return: The line without a full stop; the name of the error's type if it has no message
    """
    lines = str(error).strip().splitlines()
    return lines[0].strip().rstrip(".") if lines else type(error).__name__


def add_note(error: BaseException, note: str) -> None:
    """
    Add a note to an exception, which the traceback shows below the exception's message.

    :param error: Exception that is being handled
    :param note: Sentence to add
    """
    if sys.version_info >= (3, 11):
        error.add_note(note)
    else:
        # The traceback of Python 3.10 does not show notes, so the user gets the sentence as a warning too
        error.__notes__ = [*getattr(error, "__notes__", []), note]  # type: ignore[attr-defined]
        warnings.warn(note, RuntimeWarning)
