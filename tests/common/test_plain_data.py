"""Objects as plain data: what comes back."""

import collections
import json
import math
import pathlib
import pickle
import random
import time
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import FloatSchedule, LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_belief.common.plain_data import PlainData, decode, encode
from tests.common.plain_toys import Colour, Frozen, Nested, Node, Point, Slotted, allowed, double


def round_trip(value: Any) -> Any:
    data = encode(value, allowed)
    # What is on disk
    return decode(PlainData(json.loads(json.dumps(data.tree, allow_nan=False)), data.blob), allowed)


def same(a: Any, b: Any) -> bool:
    """Equality of all kinds, with types, and bit for bit."""
    if type(a) is not type(b):
        return False
    if isinstance(a, float):
        return np.float64(a).tobytes() == np.float64(b).tobytes()
    if isinstance(a, np.ndarray):
        if a.dtype == object:
            return a.shape == b.shape and all(map(same, a.flat, b.flat))
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, th.Tensor):
        bits = [each.detach().reshape(-1).view(th.uint8) for each in (a, b)]
        return a.dtype == b.dtype and a.shape == b.shape and a.requires_grad == b.requires_grad and th.equal(*bits)
    if isinstance(a, dict):
        return len(a) == len(b) and all(
            same(*pair) for pairs in zip(a.items(), b.items(), strict=True) for pair in zip(*pairs, strict=True)
        )
    if isinstance(a, (list, tuple, collections.deque)):
        return len(a) == len(b) and all(map(same, a, b))
    return bool(a == b)


VALUES = [
    None,
    True,
    [0, -1, 2**63, 2**200, -(2**20000)],
    [0.1, -0.0, 5e-324, 1.7976931348623157e308],
    [math.inf, -math.inf, 1.0],
    1 + 2j,
    complex(math.inf, -0.0),
    "ä\x00\ud800",
    b"abc",
    bytearray(b"xyz"),
    [],
    [1, [2, [3, "x", None]]],
    (1, (2,), ()),
    Point(1, [2]),
    TrainFreq(4, TrainFrequencyUnit.STEP),
    {"is": "list", "of": 1},
    {1: 2, (3, "x"): 4, None: 5, 1.5: 6, "s": 7},
    collections.OrderedDict([("b", 1), ("a", [2])]),
    {1, "a", (2, 3)},
    frozenset({1, frozenset({2})}),
    collections.deque([1, 2], maxlen=3),
    collections.deque([1]),
    range(1, 10, 3),
    slice(None, 5, None),
    ...,
    Colour.RED,
    pathlib.Path("a/b"),
    pathlib.PurePosixPath("/a"),
    pathlib.PureWindowsPath("c:/x"),
    np.arange(6, dtype=np.int16).reshape(2, 3),
    np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    np.arange(12.0).reshape(3, 4)[::2, ::-1],
    np.float32(3.5),
    np.int8(-1),
    np.str_("text"),
    np.str_(""),
    np.bool_(True),
    np.datetime64("2020-01-01"),
    np.array(5.0),
    np.zeros((0, 3)),
    np.array(["a", "bcd"]),
    np.array([True, False]),
    np.array([1, None, "x", [1, 2]], dtype=object),
    np.array([(1, 2.5)], dtype=[("a", "i4"), ("b", "f8")]),
    np.zeros(2, dtype=[("a", "i4", (2, 3)), ("b", [("c", "u1")])]),
    np.array([1.0], dtype=">f4"),
    np.dtype("float32"),
    np.dtype(object),
    np.dtype([("a", "i4")]),
    th.arange(6, dtype=th.int64).reshape(2, 3).T,
    th.tensor([1.5, float("nan")], dtype=th.bfloat16),
    th.zeros(0, 4),
    th.tensor(True),
    th.ones(2, requires_grad=True),
    th.nn.Parameter(th.ones(2, 2)),
    th.nn.Parameter(th.ones(1), requires_grad=False),
    th.Size([2, 3]),
    th.float16,
    th.device("cuda:1"),
    random.Random(3).getstate(),
    int,
    np.float32,
    dict,
    Node,
    Nested.Inner,
    double,
    th.nn.modules.activation.ReLU,
    Frozen(3),
    Slotted([1], "b"),
]


@pytest.mark.parametrize("value", VALUES, ids=lambda value: type(value).__name__)
def test_values_come_back_with_their_types(value):
    assert same(round_trip(value), value)
    assert same(round_trip({"x": [value]}), {"x": [value]})


def test_nan_comes_back_bit_for_bit():
    quiet = np.frombuffer(bytes.fromhex("123456789abcf8ff"), np.float64)
    assert np.float64(round_trip(float(quiet[0]))).tobytes() == np.float64(float(quiet[0])).tobytes()
    assert math.isnan(round_trip([1.0, math.nan])[1])


def random_value(rng: random.Random, depth: int) -> Any:
    leaves = [
        lambda: rng.randint(-(2**70), 2**70),
        lambda: rng.uniform(-1e9, 1e9),
        lambda: rng.choice([None, True, False, math.inf, "", "é" * 3, b"\x00\xff"]),
        lambda: np.frombuffer(rng.randbytes(8 * 4), np.int64).reshape(2, 2).copy(),
        lambda: th.tensor([rng.random()]),
        lambda: rng.choice(list(Colour)),
    ]
    if depth == 0 or rng.random() < 0.2:
        return rng.choice(leaves)()
    many = [random_value(rng, depth - 1) for _ in range(rng.randrange(4))]
    return rng.choice(
        [
            lambda: many,
            lambda: tuple(many),
            lambda: {str(index): each for index, each in enumerate(many)},
            lambda: {index: each for index, each in enumerate(many)},
            lambda: collections.deque(many, maxlen=10),
            lambda: Point(many, many[:1]),
        ]
    )()


def test_random_structures_come_back():
    rng = random.Random(0)
    for _ in range(300):
        value = random_value(rng, 5)
        assert same(round_trip(value), value)


def test_what_is_shared_is_shared_again():
    inner, array, tensor, node = [1], np.zeros(2), th.zeros(2), Node()
    back = round_trip({"a": [inner, array, tensor, node], "b": (inner, array, tensor, node)})
    assert all(one is other for one, other in zip(back["a"], back["b"], strict=True))
    assert back["a"][0] is not back["a"][1]


def test_what_holds_itself_does_so_again():
    cycle: list[Any] = []
    cycle.append({"me": cycle})
    back = round_trip(cycle)
    assert back[0]["me"] is back
    node: Any = Node()
    node.others, node.pair = [node], (node, [node])
    back = round_trip(node)
    assert back.others[0] is back and back.pair[0] is back and back.pair[1][0] is back
    # A tuple, which cannot be made before its parts, entered at the tuple
    part: list[Any] = []
    whole = (part, 5)
    part.append(whole)
    back = round_trip([whole, whole])
    assert back[0][0][0] is back[0] and back[1] is back[0] and back[0][1] == 5


def test_objects_are_rebuilt_without_their_constructor():
    before = Node.made
    node: Any = Node(x=[1], y=np.arange(3))
    back = round_trip(node)
    assert Node.made == before + 1 and back.x == [1] and np.array_equal(back.y, node.y)


def test_bound_methods_are_of_the_object_that_came_back():
    node: Any = Node()
    node.callback = node.chase
    back = round_trip(node)
    assert back.callback.__self__ is back and back.callback() == "chasing"
    first, second = round_trip((node.chase, node))
    assert first.__self__ is second


def test_defaultdicts_keep_their_factory():
    back = round_trip(collections.defaultdict(list, {"a": [1]}))
    assert back["new"] == [] and back["a"] == [1]
    assert round_trip(collections.defaultdict(None, {1: 2})).default_factory is None


@pytest.mark.parametrize("kind", ["PCG64", "PCG64DXSM", "MT19937", "Philox", "SFC64"])
def test_numpy_generators_go_on_as_they_would_have(kind):
    rng = np.random.Generator(getattr(np.random, kind)(5))
    rng.integers(10, size=3, dtype=np.int32), rng.spawn(2)
    back = round_trip({"a": rng, "b": rng.bit_generator})
    assert back["a"].bit_generator is back["b"]
    back = back["a"]
    assert np.array_equal(back.random(50), rng.random(50)) and np.array_equal(
        back.integers(9, size=9), rng.integers(9, size=9)
    )
    assert back.spawn(1)[0].random() == rng.spawn(1)[0].random()


def test_other_generators_go_on_as_they_would_have():
    old = np.random.RandomState(3)
    old.normal(), old.random_sample()
    assert np.array_equal(round_trip(old).normal(size=9), old.normal(size=9))
    plain = random.Random(4)
    plain.gauss(0, 1)
    back = round_trip(plain)
    assert [back.gauss(0, 1) for _ in range(5)] == [plain.gauss(0, 1) for _ in range(5)]
    torch = th.Generator().manual_seed(5)
    th.rand(3, generator=torch)
    assert th.equal(th.rand(5, generator=round_trip(torch)), th.rand(5, generator=torch))
    sequence = np.random.SeedSequence([1, 2], spawn_key=(3,))
    sequence.spawn(2)
    assert round_trip(sequence).spawn(1)[0].generate_state(4).tolist() == sequence.spawn(1)[0].generate_state(4).tolist()


@pytest.mark.parametrize(
    "space",
    [
        gym.spaces.Box(-1, np.array([1, np.inf], dtype=np.float32), dtype=np.float32),
        gym.spaces.Discrete(3, start=2),
        gym.spaces.MultiDiscrete([2, 3]),
        gym.spaces.MultiBinary(4),
        gym.spaces.Text(5),
        gym.spaces.Tuple([gym.spaces.Discrete(2), gym.spaces.Discrete(3)]),
        gym.spaces.Dict({"b": gym.spaces.Discrete(2), "a": gym.spaces.Box(0, 255, (3,), np.uint8)}),
    ],
)
def test_spaces_come_back_with_their_generators(space):
    space.seed(3)
    space.sample()
    back = round_trip(space)
    assert back == space and str(back) == str(space)
    assert same(*(dict(each) if isinstance(space, gym.spaces.Dict) else each for each in (back.sample(), space.sample())))


def test_objects_of_stable_baselines3_come_back():
    schedule = FloatSchedule(LinearSchedule(1.0, 0.0, 0.5))
    assert [round_trip(schedule)(p) for p in (1.0, 0.7, 0.2)] == [schedule(p) for p in (1.0, 0.7, 0.2)]
    assert str(round_trip(NormalActionNoise(np.zeros(2), np.ones(2)))) == str(NormalActionNoise(np.zeros(2), np.ones(2)))
    noise = OrnsteinUhlenbeckActionNoise(np.zeros(2), np.ones(2))
    noise()
    assert np.array_equal(round_trip(noise).noise_prev, noise.noise_prev)
    box = gym.spaces.Box(-1, 1, (3,))
    buffer = ReplayBuffer(50, box, gym.spaces.Discrete(2), "cpu")
    buffer.add(np.ones(3), np.zeros(3), np.array([1]), np.array([0.5]), np.array([False]), [{}])
    back = round_trip(buffer)
    assert np.array_equal(back.observations, buffer.observations) and back.pos == 1
    assert back.sample(4).observations.shape == (4, 3)


def test_statistics_come_back_without_their_environment():
    venv = VecNormalize(DummyVecEnv([lambda: gym.make("CartPole-v1")]))
    venv.reset()
    for _ in range(5):
        venv.step(np.array([0]))
    back = round_trip(venv)
    assert type(back) is VecNormalize and back.venv is None and np.array_equal(back.returns, venv.returns)
    assert np.array_equal(back.obs_rms.mean, venv.obs_rms.mean)
    back.set_venv(venv.venv)
    assert back.reset().shape == (1, 4)


def test_no_pickle_takes_part(monkeypatch):
    def blocked(*args, **kwargs):
        raise AssertionError("pickle was used")

    for name in ("loads", "load", "dumps", "dump", "Unpickler", "Pickler"):
        monkeypatch.setattr(pickle, name, blocked)
    rng = np.random.default_rng(0)
    value = [Node(x=np.arange(3), y=th.zeros(2), z=gym.spaces.Discrete(2)), rng, th.Generator(), random.Random(0)]
    assert len(round_trip(value)) == 4


def test_numbers_take_less_than_a_microsecond_each():
    values = [[float(index) / 3 for index in range(1000)] for _ in range(100)]
    start = time.perf_counter()
    back = decode(encode(values, allowed), allowed)
    # A hundred times what it takes
    assert time.perf_counter() - start < 10 and back == values
