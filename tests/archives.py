"""Changed copies of saved teams and models, as a stranger could make them: with sums that fit what was changed, or without."""

import base64
import hashlib
import io
import json
import os
import pickle
import zipfile
from collections.abc import Callable
from typing import Any

SUMS = "SHA256SUMS"


class Evil:
    """
    What a stranger's pickle may hold: a call of anything.

    :param path: Folder that it makes
    """

    def __init__(self, path: str):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (self.path,)


def members_of(content: bytes) -> dict[str, bytes]:
    """Return the members of a zip."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def archive_of(members: dict[str, bytes], signed: bool = True) -> bytes:
    """
    Return a zip.

    :param members: Its members
    :param signed: Whether its list of sums is made anew, if it has one
    """
    members = dict(members)
    if signed and SUMS in members:
        del members[SUMS]
        lines = [f"{hashlib.sha256(each).hexdigest()} {len(each)} {name}\n" for name, each in members.items()]
        members[SUMS] = "".join(lines).encode()
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, each in members.items():
            archive.writestr(name, each)
    return file.getvalue()


def changed(name: str, change: Callable[[bytes], bytes], signed: bool = True) -> Callable[[bytes], bytes]:
    """
    Return a function that changes a member of a zip.

    :param name: Of the member, which is added if there is none
    :param change: Returns its new contents
    :param signed: See ``archive_of``
    """

    def in_zip(content: bytes) -> bytes:
        members = members_of(content)
        return archive_of({**members, name: change(members.get(name, b""))}, signed)

    return in_zip


def rewrite(path: Any, name: str, change: Callable[[bytes], bytes], signed: bool = True) -> None:
    """Change a member of a zip on the disk."""
    with open(path, "rb") as file:
        content = file.read()
    with open(path, "wb") as file:
        file.write(changed(name, change, signed)(content))


def changed_json(**entries: Any) -> Callable[[bytes], bytes]:
    """Return a function that changes entries of a JSON mapping."""
    return lambda text: json.dumps({**json.loads(text), **entries}).encode()


def evil_data(key: str, path: str) -> Callable[[bytes], bytes]:
    """Return a function that puts a pickle with a call into SB3's data."""
    pickled = base64.b64encode(pickle.dumps(Evil(path))).decode()
    return changed_json(**{key: {":type:": "x", ":serialized:": pickled}})
