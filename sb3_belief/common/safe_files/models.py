"""
Models as plain data, in the zip that Stable-Baselines3 writes.

SB3 pickles what JSON cannot hold (spaces, classes, schedules). We add the same as plain data. SB3 loads the zip as ever, and
we load it by SB3's own ``load`` with ``custom_objects``, which take the place of the pickles: these are never read.
"""

import io
import os
import pathlib
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, BinaryIO, TypeVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.save_util import open_path

from sb3_belief.common.exceptions import add_note
from sb3_belief.common.plain_data import NotPlainError, PlainData, decode, encode
from sb3_belief.common.plain_data.kinds import name_of
from sb3_belief.common.safe_files.archive import SUMS, add_members, from_json, names_in, read_archive, to_json
from sb3_belief.common.safe_files.sizes import check_sizes
from sb3_belief.common.safe_files.tensors import check_tensors
from sb3_belief.common.safe_files.trust import PICKLE, Trust

#: Names of the members that this package adds, and the version of what they hold
ENTRIES, ARRAYS = "sb3_belief.json", "sb3_belief.bin"
FORMAT = 1
_PICKLED = ":serialized:"
Model = TypeVar("Model", bound=BaseAlgorithm)


class NamedContent(io.BytesIO):
    """
    A file in memory that has a name, for messages.

    :param content: Its contents
    :param name: What it is called
    """

    def __init__(self, content: bytes, name: str):
        super().__init__(content)
        self.name = name


def add_plain_data(file: BinaryIO, model: BaseAlgorithm) -> None:
    """
    Add to a zip that SB3 has written what it pickles, as plain data.

    What cannot be plain data is listed, and remains a pickle only.

    :param file: Open binary file with the zip
    :param model: The model of the zip
    """
    file.seek(0)
    if ENTRIES in names_in(file, "The zip"):
        return
    entries: dict[str, Any] = {}
    pickled: dict[str, str] = {}
    blobs = []
    for key in _pickled_keys(_settings(_member(file, "data"))):
        try:
            # Whoever reads decides what it may name
            data = encode(vars(model)[key], lambda module: True, key)
        except (NotPlainError, KeyError) as error:
            pickled[key] = str(error)
            continue
        entries[key] = {"tree": data.tree, "size": len(data.blob)}
        blobs.append(data.blob)
    about = {"format": FORMAT, "class": name_of(type(model)), "entries": entries, "pickled": pickled}
    file.seek(0)
    add_members(file, {ENTRIES: to_json(about), ARRAYS: b"".join(blobs)})


def write_model(path: str | os.PathLike[str] | io.BufferedIOBase, content: bytes) -> None:
    """
    Write a model's zip as SB3 does: with its ending, and its folder made.

    :param path: Path, or open binary file
    :param content: The zip
    """
    target: Any = pathlib.Path(path) if isinstance(path, os.PathLike) else path
    file = open_path(target, "w", verbose=0, suffix="zip")
    file.write(content)
    if not isinstance(path, io.BufferedIOBase):
        file.close()


def read_model(path: Any) -> tuple[bytes, str]:
    """
    Read a model's file as SB3 does: with or without its ending.

    :param path: Path, or open binary file
    :return: Its contents, and what it is called in messages
    """
    # Open files have a name, too, but for those in memory
    name = os.fspath(path) if isinstance(path, (str, os.PathLike)) else getattr(path, "name", None)
    where = name if isinstance(name, str) else "The open file"
    file = open_path(pathlib.Path(path) if isinstance(path, os.PathLike) else path, "r", verbose=0, suffix="zip")
    try:
        # An open file may be where its last use has left it
        file.seek(0)
        return file.read(), where
    finally:
        if isinstance(path, (str, os.PathLike)):
            file.close()


def class_of(content: bytes, where: str) -> str | None:
    """
    Return the name of the class of a model.

    :param content: Its zip
    :param where: What the file is called in messages
    :return: ``"module:qualname"``, None if SB3 has written the zip alone, which then does not say so
    :raises ValueError: If it is damaged
    """
    if ENTRIES not in names_in(io.BytesIO(content), where):
        return None
    return str(_about(read_archive(io.BytesIO(content), where), where, len(content))["class"])


def load_model_zip(
    load: Callable[..., Model], content: bytes, where: str, trust: Trust, custom_objects: dict[str, Any] | None, **kwargs: Any
) -> Model:
    """
    Load a model by SB3's own ``load``, which is given nothing to unpickle unless the file is trusted.

    :param load: SB3's ``load`` of the model's class
    :param content: The zip
    :param where: What the file is called in messages
    :param trust: Whom it may name
    :param custom_objects: As for ``load``
    :param kwargs: Further arguments of ``load``
    :return: The model
    :raises ValueError: If the file is damaged, needs a pickle or a package that is not trusted, or holds what is no model
    """
    objects = {**plain_objects(content, where, trust, custom_objects or {}), **(custom_objects or {})}
    try:
        return load(io.BytesIO(content), custom_objects=objects or None, **kwargs)
    # What settings lead to that no model has: another error would not say that the file is at fault
    except (LookupError, AttributeError, AssertionError, ArithmeticError, RuntimeError, MemoryError) as error:
        if isinstance(error, th.cuda.OutOfMemoryError):
            raise
        raise ValueError(f"{where} holds no model that can be made: {type(error).__name__}: {error}.") from error
    except Exception as error:
        add_note(error, f"Raised while {where} was loaded.")
        raise


def plain_objects(content: bytes, where: str, trust: Trust, given: Mapping[str, Any]) -> dict[str, Any]:
    """
    Check a model's zip, and return what takes the place of all pickles in it.

    :param content: The zip
    :param where: What the file is called in messages
    :param trust: Whom it may name
    :param given: Entries that the user replaces
    :return: The entries by name; none if the file is trusted
    :raises ValueError: If the file is damaged, or needs a pickle or a package that is not trusted
    """
    names = names_in(io.BytesIO(content), where)
    if ENTRIES not in names and SUMS not in names:
        if trust.trust_pickle:
            return {}
        raise ValueError(
            f"{where} has been written by Stable-Baselines3 alone, or by an earlier version of this package, and has to be"
            f" unpickled: {PICKLE}. If you trust that person: trust_pickle=True (--trust)."
        )
    members = check_parameters(content, where)
    if trust.trust_pickle:
        return {}
    about = _about(members, where, len(content))
    objects: dict[str, Any] = {}
    position = 0
    for key, entry in about["entries"].items():
        with _named(where, key, trust):
            end = position + entry["size"]
            if end < position:
                raise ValueError("its size is negative.")
            described, position = PlainData(entry["tree"], members[ARRAYS][position:end]), end
            if key not in given:
                objects[key] = decode(described, trust.allowed, key, trust.accepts)
                _check_entry(key, objects[key])
                check_sizes({key: objects[key]}, len(content))
    data = _settings(members["data"], where, len(content))
    if "env" in data and "env" not in given:
        # Stable-Baselines3 would make an environment of that name, importing what the name says
        raise ValueError(f"{where}, member 'data': it holds an environment, which is not loaded from a file.")
    with _named(where, "policy_kwargs", trust):
        check_sizes(data, len(content))
    for key in _pickled_keys(data):
        if key not in objects and key not in given:
            reason = str(about["pickled"].get(key, f"{ENTRIES} does not have it"))
            raise ValueError(
                f"{where}: its entry {key!r} is there as a pickle only ({reason[:300]}), and {PICKLE}. If you trust that"
                f" person: trust_pickle=True (--trust). Or replace it: custom_objects={{{key!r}: ...}}."
            )
    return objects


def check_parameters(content: bytes, where: str) -> dict[str, bytes]:
    """
    Check a model's zip, and that its parameters are tensors.

    :param content: The zip
    :param where: What the file is called in messages
    :return: Its members by name
    :raises ValueError: If it is damaged or holds something else
    """
    members = read_archive(io.BytesIO(content), where)
    for name in members:
        if name.endswith(".pth"):
            check_tensors(members[name], f"{where}, member {name!r}")
    return members


@contextmanager
def _named(where: str, key: str, trust: Trust) -> Iterator[None]:
    try:
        yield
    # Numbers and keys of a wrong kind raise whatever they raise
    except Exception as error:
        raise ValueError(
            f"{where}, member {ENTRIES!r}, entry {key!r}: {error} Packages that may be named besides the known ones:"
            f" {list(trust.allow_packages)}; more with allow_packages=('my_package',) (--allow-package). Or replace the entry:"
            f" custom_objects={{{key!r}: ...}}."
        ) from None


def _check_entry(key: str, value: Any) -> None:
    is_policy = isinstance(value, type) and issubclass(value, BasePolicy)
    if (key == "policy_class" and not is_policy) or (key.endswith("_space") and not isinstance(value, spaces.Space)):
        raise ValueError(f"{str(value)[:100]} is none.")


def _about(members: Mapping[str, bytes], where: str, size: int) -> dict[str, Any]:
    for name in (ENTRIES, ARRAYS, "data"):
        if name not in members:
            raise ValueError(f"{where}, member {name!r}: it is missing.")
    about = from_json(members[ENTRIES], f"{where}, member {ENTRIES!r}", size)
    kinds = {"format": int, "class": str, "entries": dict, "pickled": dict}
    if not isinstance(about, dict) or any(not isinstance(about.get(key), kind) for key, kind in kinds.items()):
        raise ValueError(f"{where}, member {ENTRIES!r}: it must have {list(kinds)}.")
    if about["format"] != FORMAT:
        raise ValueError(f"{where}, member {ENTRIES!r}: it has the format {about['format']}; this version reads {FORMAT}.")
    return about


def _settings(data: bytes, where: str = "The zip", size: int = 2**62) -> dict[str, Any]:
    found = from_json(data, f"{where}, member 'data'", size)
    if not isinstance(found, dict):
        raise ValueError(f"{where}, member 'data': it is no mapping.")
    return found


def _pickled_keys(settings: dict[str, Any]) -> list[str]:
    return [key for key, value in settings.items() if isinstance(value, dict) and _PICKLED in value]


def _member(file: BinaryIO, name: str) -> bytes:
    with zipfile.ZipFile(file) as archive:
        return archive.read(name)
