"""
Zips whose members are listed in a last one, ``SHA256SUMS``, with hash, size and name each.

What is read from one is what was written, or a ``ValueError`` names the member. Members are not compressed (weights hardly
shrink), so that nothing can be unpacked to more than the file itself.
"""

import hashlib
import io
import json
import re
import zipfile
from collections.abc import Callable, Mapping
from typing import IO, Any, BinaryIO

SUMS = "SHA256SUMS"
#: Members of an archive, far more than any team has
_MOST_MEMBERS = 50_000
_CHUNK = 2**20
# Numbers, texts and containers in a JSON text: so many, and one more for each two bytes of the file
_LEAST_PARTS = 500_000


class _Unsafe(Exception):
    """Raised for what makes an archive unreadable: the member and the reason."""


def write_archive(file: IO[bytes] | io.BufferedIOBase, members: Mapping[str, bytes | Callable[[], bytes]]) -> None:
    """
    Write an archive, with the list of its members at the end.

    :param file: Open binary file
    :param members: Contents of the members, or functions that return them when they are written, by name
    """
    with zipfile.ZipFile(file, "w") as archive:
        lines = []
        for name, given in members.items():
            content = given() if callable(given) else given
            archive.writestr(name, content)
            lines.append(_line(name, content))
        archive.writestr(SUMS, "".join(lines))


def add_members(file: BinaryIO, members: Mapping[str, bytes]) -> None:
    """
    Add members to a zip that another library has written, with the list of all its members at the end.

    :param file: Open binary file with the zip
    :param members: Contents of the new members by name
    """
    with zipfile.ZipFile(file, "a") as archive:
        lines = [_line(name, archive.read(name)) for name in archive.namelist()]
        for name, content in members.items():
            archive.writestr(name, content)
            lines.append(_line(name, content))
        archive.writestr(SUMS, "".join(lines))


def _line(name: str, content: bytes) -> str:
    return f"{hashlib.sha256(content).hexdigest()} {len(content)} {name}\n"


def names_in(file: BinaryIO, where: str) -> list[str]:
    """
    Return the names of the members of any zip.

    :param file: Open binary file
    :param where: What the file is called in messages
    :return: The names
    :raises ValueError: If it is no zip
    """
    try:
        with zipfile.ZipFile(file) as archive:
            if min((each.header_offset for each in archive.infolist()), default=0) != 0:
                # What is left of a team's file that was cut off may end as the zip of an agent does
                raise _Unsafe("something is in front of its members, as in a file that was cut off")
            return archive.namelist()
    # A damaged file makes zipfile raise whatever its numbers lead to
    except Exception as error:
        raise ValueError(f"{where} wasn't a zip-file, or it is damaged: {_text(error)}.") from None


def read_archive(file: BinaryIO, where: str) -> dict[str, bytes]:
    """
    Read an archive, and check that it is as it was written.

    :param file: Open binary file
    :param where: What the file is called in messages
    :return: The contents of its members by name
    :raises ValueError: If it is damaged, was changed, or claims more than it can hold. The message names the member
    """
    member = SUMS
    try:
        size = file.seek(0, io.SEEK_END)
        with zipfile.ZipFile(file) as archive:
            infos = _check_directory(archive, size, file)
            listed = _listed(archive.open(infos.pop(SUMS)).read(size))
            for member in {**listed, **infos}:
                if member not in infos:
                    raise _Unsafe("it is missing")
                if member not in listed:
                    raise _Unsafe(f"it is not listed in {SUMS}")
                if listed[member][1] != infos[member].file_size:
                    raise _Unsafe(f"it has {infos[member].file_size} bytes, and {listed[member][1]} when it was written")
            found = {}
            for member, (digest, length) in listed.items():
                found[member] = _read(archive, infos[member], length)
                if hashlib.sha256(found[member]).hexdigest() != digest:
                    raise _Unsafe("its contents are not those that were written (SHA-256)")
    except _Unsafe as error:
        raise ValueError(f"{where}, member {member!r}: {error}. The file is damaged, or has been changed.") from None
    # zipfile raises whatever wrong numbers lead to (struct.error, NotImplementedError, OverflowError, ...)
    except Exception as error:
        raise ValueError(f"{where}, member {member!r}: it cannot be read: {_text(error)}. The file is damaged.") from None
    return found


def _check_directory(archive: zipfile.ZipFile, size: int, file: BinaryIO) -> dict[str, zipfile.ZipInfo]:
    infos = archive.infolist()
    if len(infos) > _MOST_MEMBERS:
        raise _Unsafe(f"the file has {len(infos)} members")
    # So no other zip lies in front of this one, or behind
    file.seek(size - 22)
    if min((each.header_offset for each in infos), default=1) != 0 or file.read(4) != b"PK\5\6":
        raise _Unsafe("the file has something in front of its members or behind")
    for each in infos:
        check_name(each.filename)
        if each.orig_filename != each.filename or each.flag_bits & ~(0x800 | 0x8):
            raise _Unsafe(f"{each.filename[:100]!r} is encrypted, or of another unusual kind")
        if each.compress_type != zipfile.ZIP_STORED or each.compress_size != each.file_size:
            raise _Unsafe(f"{each.filename[:100]!r} is compressed, which this package does not do")
    total = sum(each.file_size for each in infos)
    if total > size:
        raise _Unsafe(f"the members claim {total:,} bytes, more than the {size:,} of the file")
    found = {each.filename: each for each in infos}
    if len(found) != len(infos):
        raise _Unsafe("two members have the same name")
    if SUMS not in found:
        raise _Unsafe("it is missing")
    return found


def check_name(name: str) -> None:
    """
    Check that the name of a member leads nowhere.

    :param name: Name of the member
    """
    parts = name.split("/")
    if re.search(r"[\\\x00-\x1f]|^\w:", name) or any(part in ("", ".", "..") for part in parts):
        raise _Unsafe(f"{name[:100]!r} is no name of a member")


def _listed(content: bytes) -> dict[str, tuple[str, int]]:
    found = {}
    for line in content.decode().splitlines():
        digest, length, name = line.split(" ", 2)
        if name in found or not re.fullmatch("[0-9a-f]{64}", digest) or not re.fullmatch(r"\d{1,15}", length, re.ASCII):
            raise _Unsafe(f"its line {line[:200]!r} is not as it was written")
        found[name] = digest, int(length)
    return found


def _read(archive: zipfile.ZipFile, info: zipfile.ZipInfo, length: int) -> bytes:
    parts, n_read = [], 0
    with archive.open(info) as member:
        # In parts, so that never more is unpacked than the member is said to have
        while part := member.read(min(_CHUNK, length + 1 - n_read)):
            parts.append(part)
            n_read += len(part)
            if n_read > length:
                break
    if n_read != length:
        raise _Unsafe(f"it has {n_read} bytes or more instead of {length}")
    return b"".join(parts)


def to_json(value: Any, indent: int | None = None) -> bytes:
    """
    Return JSON for a member.

    :param value: Plain data, whose order is kept
    :param indent: Of each level, for people who read it
    """
    separators = (",", ":") if indent is None else None
    return json.dumps(value, allow_nan=False, indent=indent, separators=separators).encode()


def from_json(content: bytes, where: str, file_size: int) -> Any:
    """
    Return the value of a member of JSON.

    :param content: The member
    :param where: What it is called in messages
    :param file_size: Size of the file, which limits what the text may become: an empty list of two bytes takes 60 in memory
    :return: The value
    :raises ValueError: If it is no JSON, or has too many parts
    """
    n_parts = sum(content.count(sign) for sign in (b",", b"[", b"{"))
    if n_parts > max(_LEAST_PARTS, file_size // 2):
        raise ValueError(f"{where}: it has {n_parts:,} parts, which is too many for a file of {file_size:,} bytes.")
    try:
        return json.loads(content)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{where}: it is no JSON: {_text(error)}.") from None


def _text(error: Exception) -> str:
    return f"{type(error).__name__}: {str(error)[:200]}"
