"""Sizes that a model's settings claim, which its file must have the bytes for."""

import itertools
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from gymnasium import spaces


def check_sizes(settings: Any, file_size: int) -> None:
    """
    Check that spaces and networks are no larger than a model's file can be true of.

    A network has weights for each entry of its spaces, and for each pair of entries of two layers; so a small file that claims
    large ones would only have the memory filled.

    :param settings: Settings of a model, which may hold spaces
    :param file_size: Size of the model's zip in bytes
    :raises ValueError: If one is larger
    """
    for what, n_entries in _claims(settings):
        if n_entries > max(file_size, 10_000):
            raise ValueError(f"{what} has {n_entries:,} entries, which a file of {file_size:,} bytes has no weights for.")


def _claims(value: Any) -> Iterator[tuple[str, int]]:
    if isinstance(value, spaces.Space):
        yield from _of_space(value)
    elif isinstance(value, dict):
        for key, each in value.items():
            if key == "net_arch":
                yield from _of_layers(each)
            else:
                yield from _claims(each)
    elif isinstance(value, (list, tuple)):
        for each in value:
            yield from _claims(each)


def _of_space(space: spaces.Space) -> Iterator[tuple[str, int]]:
    if isinstance(space, (spaces.Dict, spaces.Tuple)):
        for part in space.spaces.values() if isinstance(space, spaces.Dict) else space.spaces:
            yield from _claims(part)
        return
    sizes = [1]
    if isinstance(space, spaces.Discrete):
        sizes.append(int(space.n))
    elif isinstance(space, spaces.MultiDiscrete):
        sizes.append(int(np.sum(space.nvec, dtype=object)))
    if space.shape is not None:
        sizes.append(math.prod(int(size) for size in space.shape))
    yield f"a {type(space).__name__} space", max(sizes)


def _of_layers(layers: Any) -> Iterator[tuple[str, int]]:
    if isinstance(layers, dict):
        for each in layers.values():
            yield from _of_layers(each)
    elif isinstance(layers, list):
        widths = [each for each in layers if isinstance(each, int)]
        for one, other in itertools.pairwise([1, *widths]):
            yield "net_arch", abs(one * other)
        for each in layers:
            if isinstance(each, (dict, list)):
                yield from _of_layers(each)
