"""A run is trained by one process at a time."""

import contextlib
import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from sb3_belief.zoo.errors import ConfigError

LOCK = ".lock"


@contextmanager
def run_lock(folder: Path) -> Iterator[None]:
    """
    Hold a run's folder, so that no other process trains the same run meanwhile. It is let go however this process ends.

    Where the file system has no locks, nothing is held.

    :param folder: Folder of the run
    :raises ConfigError: If another process holds it
    """
    path = folder / LOCK
    while True:
        file = open(path, "a+", encoding="utf-8")
        try:
            if not _lock(file):
                file.seek(0)
                holder = file.read().strip() or "another process"
                raise ConfigError(f"{folder}: this run is being trained by {holder}: wait until it has ended, or end it.")
            # Whoever held it before may have removed the file since it was opened here
            if path.exists() and os.path.samestat(os.fstat(file.fileno()), path.stat()):
                break
        except BaseException:
            file.close()
            raise
        file.close()
    try:
        file.truncate(0)
        file.write(f"process {os.getpid()} on {platform.node()}\n")
        file.flush()
        yield
    finally:
        if os.name == "nt":
            # Open files cannot be removed there
            file.close()
        with contextlib.suppress(OSError):
            path.unlink()
        file.close()


def _lock(file: IO[str]) -> bool:
    """Return whether nobody else holds the file."""
    try:
        if os.name == "nt":
            import msvcrt

            file.seek(0)
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    except OSError:
        # No locks here, as on some network file systems
        return True
    return True
