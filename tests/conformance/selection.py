"""Which tests of a suite our classes take part in."""

import inspect
from collections.abc import Iterable, Iterator, Mapping
from types import CodeType, FunctionType
from typing import Any

import pytest
from stable_baselines3.common.base_class import BaseAlgorithm


def takes_part(item: pytest.Item, examined: Iterable[type]) -> bool:
    """
    A test whose parameters name an algorithm is about that one, even where its source tells algorithms apart. Any other
    test is about the algorithms that it, or a helper of its module, refers to.

    :param item: A collected test, in whose module the classes have been put in place
    :param examined: Our classes
    :return: Whether one of them takes part in it
    """
    function = getattr(item, "function", None)
    if function is None:
        return False
    referred = list(_referred(inspect.unwrap(function), set()))
    named: set[type] = set()
    callspec = getattr(item, "callspec", None)
    for value in callspec.params.values() if callspec else ():
        named |= _algorithms(value)
        if isinstance(value, str):  # a key into a table of algorithms
            tables = (table for table in referred if isinstance(table, Mapping) and value in table)
            named |= {algorithm for table in tables for algorithm in _algorithms(table[value])}
    if not named:
        named = {algorithm for value in referred for algorithm in _algorithms(value)}
    return not named.isdisjoint(examined)


def _algorithms(value: Any) -> set[type]:
    """The algorithms in a value, or in the containers that it consists of."""
    if isinstance(value, type):
        return {value} if issubclass(value, BaseAlgorithm) else set()
    if isinstance(value, Mapping):
        return {algorithm for pair in value.items() for part in pair for algorithm in _algorithms(part)}
    if isinstance(value, (list, tuple, set, frozenset)):
        return {algorithm for part in value for algorithm in _algorithms(part)}
    return set()


def _referred(function: FunctionType, seen: set[FunctionType]) -> Iterator[Any]:
    """All globals that a function refers to, and those of the functions of the same module among them."""
    seen.add(function)
    for name in _names(function.__code__):
        value = function.__globals__.get(name)
        yield value
        if isinstance(value, FunctionType) and value.__module__ == function.__module__ and value not in seen:
            yield from _referred(value, seen)


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)
