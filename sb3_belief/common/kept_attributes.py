"""Attributes that are other ones for a while."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def kept_attributes(owner: Any, *names: str) -> Iterator[None]:
    """
    Put attributes back at the end of the block, for instance the arguments of a user, to which an algorithm adds its own while
    its model is built: those of the user are what is saved, and compared on load.

    :param owner: An object
    :param names: Names of attributes that it has
    """
    kept = {name: getattr(owner, name) for name in names}
    try:
        yield
    finally:
        for name, value in kept.items():
            setattr(owner, name, value)
