"""Files that are replaced as a whole: whatever ends the program or the machine, there is the old file or the new one."""

import contextlib
import errno
import os
import re
import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

# Name of the replaced file, number of the process and a random part
_TEMPORARY = re.compile(r"\..+\.(\d+)-[0-9a-f]{8}\.tmp")
# Temporary files that this process writes at the moment
_in_use: set[str] = set()
# File systems that cannot make folders durable say so by one of these
_CANNOT_SYNC = {errno.EINVAL, errno.ENOTSUP, errno.EACCES, errno.EPERM, errno.EBADF}
_DAY = 24 * 3600.0


@contextmanager
def replaced_file(path: str | os.PathLike[str], mode: str = "wb", **open_kwargs: Any) -> Iterator[IO[Any]]:
    """
    Open a file whose new content takes the place of the old one when the context ends without an error, and not before.

    The content is on the disk by then, not only in the system's memory, and so is the name. Until then, and after an error,
    the old file is untouched.

    :param path: The file; its folder must exist
    :param mode: ``"wb"`` for bytes, ``"w"`` for text, ``"w+"`` for text that is read again meanwhile
    :param open_kwargs: Further arguments of ``open``, e.g. ``encoding``
    :return: The open file
    :raises ValueError: If the mode is another one
    :raises OSError: If the file cannot be written, for example because the disk is full
    """
    if mode not in ("w", "w+", "wb"):
        raise ValueError(f"A file is replaced as a whole: mode must be 'w', 'w+' or 'wb', not {mode!r}.")
    target = Path(path)
    # In the same folder, since only there a rename replaces a file in one step. The name is cut, because names have a limit
    temporary = target.with_name(f".{target.name[:40]}.{os.getpid()}-{secrets.token_hex(4)}.tmp")
    _in_use.add(temporary.name)
    try:
        with open(temporary, mode, opener=_open_new, **open_kwargs) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(temporary)
        raise
    finally:
        _in_use.discard(temporary.name)
    sync_folder(target.parent)


def _open_new(path: str, flags: int) -> int:
    # Permissions as the umask says, as those of any new file
    return os.open(path, flags | os.O_EXCL, 0o666)


def sync_folder(path: str | os.PathLike[str]) -> None:
    """
    Have the system write to the disk which files a folder holds, where the system can.

    :param path: The folder
    """
    if os.name == "nt":
        # Windows does not open folders
        return
    try:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        if error.errno not in _CANNOT_SYNC:
            raise


def make_folder(path: str | os.PathLike[str]) -> Path:
    """
    Make a folder that is still there after a crash, and those above it; nothing happens if it exists.

    :param path: The folder
    :return: The folder
    """
    folder = Path(path)
    if not folder.is_dir():
        make_folder(folder.parent)
        folder.mkdir(exist_ok=True)
        sync_folder(folder.parent)
    return folder


def sweep_temporary_files(folder: str | os.PathLike[str]) -> list[Path]:
    """
    Remove the files that ``replaced_file`` was writing in a folder when its process was killed.

    Those of processes that live stay, unless they are a day old: numbers of processes are used again.

    :param folder: The folder, without those below it
    :return: The files that were removed
    """
    removed = []
    for path in Path(folder).glob(".*.tmp"):
        match = _TEMPORARY.fullmatch(path.name)
        if match is None or path.name in _in_use:
            continue
        # In containers each process may be number 1: what has this process's number and is not in use was left by another
        pid = int(match[1])
        # Someone else may remove them meanwhile
        with contextlib.suppress(OSError):
            if pid == os.getpid() or not process_lives(pid) or time.time() - path.stat().st_mtime > _DAY:
                path.unlink()
                removed.append(path)
    return removed


def process_lives(pid: int) -> bool:
    """
    Return whether there is a process with a number, on this machine.

    :param pid: Number of the process
    :return: Whether it lives; True where the system cannot be asked
    """
    if os.name == "nt":
        # There os.kill() would end it
        return True
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True
