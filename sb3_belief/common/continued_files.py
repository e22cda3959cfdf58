"""Log files that a continued run goes on with: they are cut back to what they held at its checkpoint."""

import os
from collections.abc import Sequence
from pathlib import Path

from sb3_belief.common.durable_files import replaced_file


def cut_file(path: str | os.PathLike[str], size: int) -> None:
    """
    Cut a file to which rows are appended back to its first bytes.

    :param path: The file
    :param size: Number of bytes that stay
    :raises ValueError: If it has fewer
    """
    present = os.path.getsize(path)
    if present < size:
        raise _changed(path, f"it has {present} bytes, and had {size}")
    if present > size:
        with open(path, "r+b") as file:
            file.truncate(size)
            os.fsync(file.fileno())


def cut_table(path: str | os.PathLike[str], keys: Sequence[str], size: int) -> None:
    """
    Cut a CSV table of SB3's back to the columns and rows that it had.

    SB3 appends columns when values are logged under new keys, and rewrites all rows, with a comma for each new column.

    :param path: The file
    :param keys: The columns that stay
    :param size: Number of bytes of the table at that time
    :raises ValueError: If these columns and rows are not the first ones of the table
    """
    with open(path, "rb") as file:
        header = file.readline()
        expected = ",".join(keys).encode()
        names = header.rstrip(b"\r\n")
        if names == expected or not keys:
            return cut_file(path, size)
        if not names.startswith(expected + b","):
            raise _changed(path, f"its columns do not begin with {list(keys)}")
        more = b"," * (names.count(b",") - expected.count(b","))
        end = header[len(names) :]
        lines, left = [expected + end], size - len(expected + end)
        while left > 0:
            line = file.readline()
            row = line.removesuffix(end).removesuffix(more) + end
            if not line.endswith(more + end) or len(row) > left:
                raise _changed(path, f"its first rows are not those of the {size} bytes that it had")
            lines.append(row)
            left -= len(row)
    with replaced_file(path) as new:
        new.writelines(lines)


def sync_file(path: str | os.PathLike[str]) -> None:
    """
    Have the system write to the disk what it holds of a file.

    :param path: The file
    """
    # Windows syncs only what is open for writing
    with open(path, "r+b") as file:
        os.fsync(file.fileno())


def _changed(path: str | os.PathLike[str], how: str) -> ValueError:
    return ValueError(
        f"{Path(path)} is not the log of this run any more: {how} when the checkpoint was made. Put the file back, or move it"
        " away to begin a new one."
    )
