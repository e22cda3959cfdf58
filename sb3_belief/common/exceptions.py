"""Notes on exceptions, also for Python 3.10, which does not have them yet."""

import sys
import warnings


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
