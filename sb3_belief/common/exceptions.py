"""Notes on exceptions, also where Python has none yet."""

import sys
import warnings


def add_note(error: BaseException, note: str) -> None:
    """
    :param error: an exception under way
    :param note: what to say besides
    """
    if sys.version_info >= (3, 11):
        error.add_note(note)
    else:
        # Python 3.10 shows no notes with a traceback
        error.__notes__ = [*getattr(error, "__notes__", []), note]  # type: ignore[attr-defined]
        warnings.warn(note, RuntimeWarning)
