"""What is refused as plain data, when it is written and when it is read."""

import collections
import functools
import json
import random
import sys
import threading
import weakref
from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_belief.common.plain_data import NotPlainError, PlainData, decode, encode
from tests.common.plain_toys import Colour, Flags, Node, OwnState, Point, Refusing, allowed, double


def local() -> Any:
    def inner():
        pass

    return inner


REFUSED = [
    (lambda: lambda: 0, "<lambda>"),
    (local, "<locals>"),
    (lambda: weakref.ref(Node()), "weakref"),
    (lambda: (x for x in (1,)), "generator"),
    (lambda: open(__file__, "rb"), "_io"),
    (lambda: threading.Lock(), "_thread"),
    (lambda: threading.Thread(), "threading"),
    (lambda: print, "builtin"),
    (lambda: json.dumps, "json"),
    (lambda: functools.partial(double), "functools"),
    (lambda: Flags.A | Flags.B, "combination"),
    (lambda: OwnState(), "__setstate__"),
    (lambda: Refusing(), "__reduce__"),
    (lambda: Node(chase=5), "'chase' replaces a method"),
    (lambda: th.nn.Linear(2, 2), "state_dict"),
    (lambda: th.zeros(2).to_sparse(), "sparse"),
    (lambda: "x".upper, "builtin_function"),
    (lambda: dict.fromkeys, "builtin_function"),
    (lambda: type("Local", (), {}), "Local"),
    (lambda: collections.Counter("ab"), "Counter"),
    (lambda: np.zeros(2, dtype=[("a", object)]), "objects"),
    (lambda: np.ma.masked_array([1]), "numpy.ma"),
]


@pytest.mark.parametrize(("make", "words"), REFUSED)
def test_what_is_not_plain_is_refused_with_its_place(make, words):
    with pytest.raises(NotPlainError, match=r"team\['a'\]\[1\]\.part .*") as error:
        encode({"a": [0, Node(part=make())]}, allowed, "team")
    assert words in str(error.value)


def test_too_deep_is_refused():
    value: Any = []
    for _ in range(500):
        value = [value]
    with pytest.raises(NotPlainError, match="deep"):
        encode(value, allowed)
    tree: Any = {"is": "list", "of": []}
    for _ in range(500):
        tree = {"is": "list", "of": [tree]}
    with pytest.raises(ValueError, match="deep"):
        decode(PlainData(tree, b""), allowed)


def test_only_what_is_accepted_may_be_named():
    assert decode(encode(Node(x=1), allowed), allowed, accepts=lambda found: found is Node).x == 1
    with pytest.raises(NotPlainError, match="Node"):
        encode(Node(), allowed, accepts=lambda found: found is not Node)
    for value in (Node(), Node, double, Node().chase, Colour.RED, Point(1, 2)):
        with pytest.raises(ValueError, match="may name"):
            decode(encode(value, allowed), allowed, accepts=lambda found: False)


ARRAY = {"is": "array", "dtype": "<f8", "shape": [1], "order": "C"}
TENSOR = {"is": "tensor", "dtype": "float64", "shape": [1], "grad": False, "parameter": False}
MT = {"is": "dict", "of": {"key": {**ARRAY, "dtype": "<u4", "shape": [624]}, "pos": 700}}
BAD = [
    [1],
    {},
    {"is": "nothing"},
    {"is": ["list"], "of": []},
    {"is": "list"},
    {"is": "list", "of": {}},
    {"is": "list", "of": [], "more": 1},
    {"is": "list", "of": [], "to": 1},
    {"is": "list", "of": [], "id": "a"},
    {"is": "list", "of": [{"is": "list", "of": [], "id": 1}, {"is": "list", "of": [], "id": 1}]},
    {"is": "ref", "to": 0},
    {"is": "ref"},
    {"is": "tuple", "of": [{"is": "list", "of": [], "id": 0}], "to": 0},
    {"is": "dict", "of": []},
    {"is": "map", "of": [[1]]},
    {"is": "map", "of": [[{"is": "list", "of": []}, 1]]},
    {"is": "set", "of": [{"is": "list", "of": []}]},
    {"is": "deque", "of": [], "longest": -1},
    {"is": "float", "bits": "00"},
    {"is": "int", "hex": "zz"},
    {"is": "range", "of": [0, 1, 0]},
    {"is": "bytes", "size": 9},
    {"is": "bytes", "size": -1},
    {"is": "bytes", "size": True},
    {**ARRAY, "shape": [2]},
    {**ARRAY, "shape": [-1]},
    {**ARRAY, "shape": [2**40, 2**40]},
    {**ARRAY, "shape": 1},
    {**ARRAY, "shape": [True]},
    {**ARRAY, "dtype": "O"},
    {**ARRAY, "dtype": "|O"},
    {**ARRAY, "dtype": [["a", "|O"]]},
    {**ARRAY, "dtype": "i4,O"},
    {**ARRAY, "dtype": "U0", "shape": [2**40]},
    {**ARRAY, "dtype": 5},
    {**ARRAY, "order": "K"},
    {"is": "objects", "shape": [2**40], "of": []},
    {**TENSOR, "shape": [2]},
    {**TENSOR, "dtype": "qint8"},
    {**TENSOR, "grad": 1},
    {**TENSOR, "dtype": "int64", "grad": True},
    {"is": "scalar", "dtype": "S9"},
    {"is": "scalar", "dtype": "O"},
    {"is": "generator", "bits": 5},
    {"is": "bit_generator", "name": "Evil", "seed": None, "state": None},
    {"is": "random", "state": {"is": "tuple", "of": [3, {"is": "tuple", "of": [0] * 624 + [700]}, None]}},
    {"is": "seed_sequence", "state": {"is": "dict", "of": {"entropy": 1, "pool_size": 10**9}}},
    {"is": "class", "name": "os:system"},
    {"is": "class", "name": "builtins:eval"},
    {"is": "class", "name": 5},
    {"is": "class", "name": "tests.common.plain_toys:double"},
    {"is": "class", "name": "tests.common.plain_toys:Any"},
    {"is": "class", "name": "tests.common.plain_toys:dataclasses.Field"},
    {"is": "class", "name": "tests.common.nowhere:Thing"},
    {"is": "class", "name": "stable_baselines3.common.save_util:pathlib.Path"},
    {"is": "class", "name": "tests.common.plain_toys:Node.__class__"},
    {"is": "function", "name": "os:system"},
    {"is": "function", "name": "builtins:eval"},
    {"is": "function", "name": "tests.common.plain_toys:Node"},
    {"is": "function", "name": "tests.common.plain_toys:dataclasses.fields"},
    {"is": "method", "name": "upper", "self": "text"},
    {"is": "method", "name": "__init__", "self": {"is": "object", "class": "tests.common.plain_toys:Node", "state": {}}},
    {"is": "object", "class": "tests.common.plain_toys:OwnState", "state": {}},
    {"is": "object", "class": "tests.common.plain_toys:Node", "state": {"chase": 1}},
    {"is": "object", "class": "tests.common.plain_toys:Node", "state": []},
    {"is": "object", "class": "torch.nn.modules.linear:Linear", "state": {}},
    {"is": "object", "class": "builtins:int", "state": {}},
    {"is": "namedtuple", "class": "tests.common.plain_toys:Point", "of": [1]},
    {"is": "namedtuple", "class": "tests.common.plain_toys:Node", "of": [1]},
    {"is": "enum", "class": "tests.common.plain_toys:Colour", "name": "GREEN"},
    {"is": "enum", "class": "tests.common.plain_toys:Node", "name": "x"},
    {"is": "device", "name": "nowhere"},
    {"is": "torch_dtype", "name": "nowhere"},
]


@pytest.mark.parametrize("tree", BAD, ids=lambda tree: str(tree)[:60])
def test_wrong_data_is_one_kind_of_error_with_its_place(tree):
    with pytest.raises(ValueError, match=r"^team\['x'\].* is not readable plain data: "):
        decode(PlainData({"is": "dict", "of": {"x": tree}}, b"12345678"), allowed, "team")


def test_positions_beyond_a_generators_state_are_refused():
    state = np.random.MT19937(0).state
    for wrong in (625, -1):
        data = encode(np.random.MT19937(0), allowed)
        text = json.dumps(data.tree).replace(f'"pos": {state["state"]["pos"]}', f'"pos": {wrong}')
        with pytest.raises(ValueError, match=r"pos|integer"):
            decode(PlainData(json.loads(text), data.blob), allowed)
    data = encode(np.random.Philox(0), allowed)
    with pytest.raises(ValueError, match="buffer_pos"):
        decode(PlainData(json.loads(json.dumps(data.tree).replace('"buffer_pos": 4', '"buffer_pos": 5')), data.blob), allowed)


def test_bytes_that_are_left_over_are_refused():
    data = encode([np.zeros(3)], allowed)
    with pytest.raises(ValueError, match="left over"):
        decode(PlainData(data.tree, data.blob + b"x"), allowed)


def test_a_module_that_is_not_allowed_is_not_imported():
    asked: list[str] = []

    def refuse(module):
        asked.append(module)
        return False

    with pytest.raises(ValueError, match="not allowed"):
        decode(PlainData({"is": "class", "name": "antigravity:x"}, b""), refuse)
    assert asked == ["antigravity"] and "antigravity" not in sys.modules
    # A program, although its package is allowed
    with pytest.raises(ValueError, match="not allowed"):
        decode(PlainData({"is": "class", "name": "tests.conformance.__main__:x"}, b""), lambda module: True)


def test_random_damage_never_raises_anything_else():
    rng = random.Random(1)
    value = [Node(a=[np.arange(5), th.zeros(2)], b=(1, {2: 3})), np.random.default_rng(0), Colour.RED, Point(1, 2), double]
    data = encode(value, allowed)
    text = json.dumps(data.tree)
    for _ in range(2000):
        start = rng.randrange(len(text))
        changed = (
            text[:start] + rng.choice(["", "0", "-", "[", "]", '"', "9999", "null", "x"]) + text[start + rng.randrange(3) :]
        )
        try:
            tree = json.loads(changed)
        except ValueError:
            continue
        try:
            decode(PlainData(tree, data.blob), allowed)
        except ValueError:
            pass
