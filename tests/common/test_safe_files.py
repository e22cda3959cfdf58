"""Archives whose members are checked, files of tensors, sizes, and whom a file is trusted to name."""

import collections
import hashlib
import io
import re
import struct
import zipfile
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.logger import CSVOutputFormat
from stable_baselines3.common.save_util import load_from_pkl
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import LinearSchedule

from sb3_belief.common.safe_files.archive import (
    SUMS,
    add_members,
    from_json,
    names_in,
    read_archive,
    to_json,
    write_archive,
)
from sb3_belief.common.safe_files.sizes import check_sizes
from sb3_belief.common.safe_files.tensors import check_tensors
from sb3_belief.common.safe_files.trust import UNTRUSTED, Trust
from tests.archives import archive_of, changed, members_of

CONTENTS = {"a.json": b"{}", "b/c.bin": bytes(5000), "d.zip": b"x" * 10}


def written():
    file = io.BytesIO()
    write_archive(file, {**CONTENTS, "d.zip": lambda: CONTENTS["d.zip"]})
    return file.getvalue()


def test_an_archive_is_read_as_it_was_written():
    content = written()
    assert read_archive(io.BytesIO(content), "here") == CONTENTS
    assert list(members_of(content)) == [*CONTENTS, SUMS]
    sums = members_of(content)[SUMS].decode().splitlines()
    assert sums[1] == f"{hashlib.sha256(bytes(5000)).hexdigest()} 5000 b/c.bin"


def test_members_are_added_to_the_zip_of_another():
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("data", "1")
    add_members(file, {"more": b"2"})
    assert read_archive(file, "here") == {"data": b"1", "more": b"2"}
    assert names_in(file, "here") == ["data", "more", SUMS]


def with_duplicate(content):
    file = io.BytesIO(content)
    with pytest.warns(UserWarning, match="Duplicate"), zipfile.ZipFile(file, "a") as archive:
        archive.writestr("a.json", "{}")
    return file.getvalue()


def patched(place, value, width=2):
    """Return a function that changes a number in the directory's first entry."""

    def change(content):
        start = content.index(b"PK\1\2") + place
        return content[:start] + value.to_bytes(width, "little") + content[start + width :]

    return change


def renamed(name):
    return lambda content: archive_of({name if key == "b/c.bin" else key: each for key, each in members_of(content).items()})


def without(name):
    return lambda content: archive_of({k: v for k, v in members_of(content).items() if k != name}, signed=False)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (changed("b/c.bin", lambda _: bytes(4999) + b"x", signed=False), r"member 'b/c\.bin': its contents are not those"),
        (changed("b/c.bin", lambda _: bytes(4999), signed=False), r"member 'b/c\.bin': it has 4999 bytes, and 5000"),
        (changed("new", lambda _: b"", signed=False), r"member 'new': it is not listed"),
        (without("a.json"), r"member 'a\.json': it is missing"),
        (without(SUMS), "member 'SHA256SUMS': it is missing"),
        (changed(SUMS, lambda old: old + b"x 1 y\n", signed=False), "its line 'x 1 y' is not as it was written"),
        (changed(SUMS, lambda old: old + old.splitlines()[0] + b"\n", signed=False), "is not as it was written"),
        (with_duplicate, "two members have the same name"),
        (lambda content: b"x" + content, "something in front"),
        (lambda content: content + b"x", "something in front of its members or behind"),
        (lambda content: content + content, "something in front"),
        *(
            (renamed(name), "is no name of a member")
            for name in ("/etc/x", "../x", "b/../../x", "b//c", "c:x", "b\\c", "b/", ".")
        ),
        (patched(8, 1), "is encrypted"),
        (patched(10, 12), "is compressed, which this package does not do"),
        (patched(24, 99, 4), "is compressed, which this package does not do"),
        (lambda content: patched(20, 10**9, 4)(patched(24, 10**9, 4)(content)), "the members claim 1,000,005,"),
        (lambda content: content[: len(content) // 2], "cannot be read"),
        (lambda content: b"", "cannot be read"),
    ],
)
def test_what_is_not_as_it_was_written_is_refused(change, says):
    with pytest.raises(ValueError, match=rf"^here, (member .*)?{says}"):
        read_archive(io.BytesIO(change(written())), "here")


def test_nothing_is_unpacked():
    # Seventy megabytes of zeros in a small file
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, each in {**members_of(written()), "zeros": bytes(70 * 2**20)}.items():
            archive.writestr(name, each)
    assert len(file.getvalue()) < 10**6
    with pytest.raises(ValueError, match="is compressed, which this package does not do"):
        read_archive(file, "here")


def test_json_is_strict_and_limited():
    assert from_json(to_json({"b": [1.5, None], "a": "é"}), "here", 0) == {"b": [1.5, None], "a": "é"}
    assert list(from_json(to_json({"b": 1, "a": 2}), "here", 0)) == ["b", "a"]
    with pytest.raises(ValueError, match="Out of range"):
        to_json(float("nan"))
    for wrong in (b"{", b"\xff", b"[" * 100_000):
        with pytest.raises(ValueError, match=r"^here: it is no JSON"):
            from_json(wrong, "here", 10**9)
    many = b"[" + b"0," * 600_000 + b"0]"
    with pytest.raises(ValueError, match="it has 600,001 parts, which is too many for a file of 1,000 bytes"):
        from_json(many, "here", 1000)
    assert len(from_json(many, "here", len(many))) == 600_001


# -- tensors -----------------------------------------------------------------------------------------------------------


def saved(value):
    file = io.BytesIO()
    th.save(value, file)
    return file.getvalue()


def test_what_models_save_is_tensors():
    network = th.nn.Sequential(th.nn.Linear(3, 4), th.nn.BatchNorm1d(4))
    optimiser = th.optim.Adam(network.parameters(), foreach=False)
    network(th.ones(2, 3)).sum().backward()
    optimiser.step()
    tensors = {
        **{f"{dtype}": th.zeros(3, dtype=dtype) for dtype in (th.bfloat16, th.float64, th.int8, th.bool, th.complex64)},
        "view": th.arange(12.0).reshape(3, 4).T[1:],
        "expanded": th.zeros(1).expand(7),
        "none": None,
        "empty": th.zeros(0, 3),
        "parameter": th.nn.Parameter(th.ones(2)),
        "number": th.tensor(3),
        "plain": [1, 2.5, "text", True, (1, (2,), ()), {"a": {}}, 2**40, -1],
        "dtype": th.float32,
        "size": th.Size([1, 2]),
    }
    for value in (network.state_dict(), optimiser.state_dict(), tensors, None, {}):
        check_tensors(saved(value), "here")


class Anything:
    pass


def as_other_entries(content, name, change):
    return changed(f"archive/{name}", change)(content)


def other_shape(content, old, new):
    """Change a number in the instructions; those of small numbers have one byte."""
    return as_other_entries(content, "data.pkl", lambda program: program.replace(b"K" + bytes([old]), new))


TWO = saved({"a": th.ones(77)})


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (saved(Anything()), "tests.common.test_safe_files.Anything"),
        (saved({"a": collections.Counter("ab")}), "collections.Counter"),
        (saved(bytearray(5)), "bytearray|_codecs"),
        (saved({1, 2}), "set"),
        (saved(th.zeros(2).to_sparse()), "sparse"),
        (saved(np.zeros(3)), "numpy"),
        (saved(th.nn.Linear(2, 2)), "Linear"),
        (b"", "no tensors"),
        (b"PK", "no tensors"),
        (TWO[: len(TWO) // 2], "no tensors"),
        (archive_of({"a/data.pkl": b"N.", "a/constants.pkl": b""}), "other members"),
        (archive_of({"a/data.pkl": b"N.", "b/data/0": b""}), "other members"),
        (archive_of({"a/version": b"3"}), "no tensors"),
        (archive_of({"a/data.pkl": b"cposix\nsystem\n(S'echo'\ntR."}), "posix.system"),
        (archive_of({"a/data.pkl": b"(S'echo'\niposix\nsystem\n."}), "instruction STRING"),
        (archive_of({"a/data.pkl": b"\x80\x04\x8c\x05posix\x8c\x06system\x93."}), "instruction STACK_GLOBAL"),
        (archive_of({"a/data.pkl": b"NN."}), "do not end with one value"),
        (archive_of({"a/data.pkl": b"h\x05."}), "no tensors"),
        # Shapes beyond what is stored
        (other_shape(TWO, 77, b"M\xff\xff"), "has 308 bytes, not the 262140"),
        (as_other_entries(TWO, "data/0", lambda old: old[:-4]), "has 304 bytes, not the 308"),
        (TWO.replace(b"data/0", b"data/9"), "no tensors"),
    ],
)
def test_what_is_no_tensors_is_refused(content, says):
    with pytest.raises(ValueError, match=rf"^here: .*({says})"):
        check_tensors(content, "here")


def test_a_tensor_may_not_be_larger_than_its_storage():
    program = members_of(TWO)["archive/data.pkl"]
    # The shape is the last tuple of one number before the strides
    shape: Any = re.search(rb"KM(?=\x85q.K\x01\x85)", program)
    for size, says in ((78, "of shape \\(78,\\) in a storage of 77 entries"), (10**6, "of shape \\(1000000,\\)")):
        larger = program[: shape.start()] + b"J" + struct.pack("<i", size) + program[shape.end() :]
        with pytest.raises(ValueError, match=says):
            check_tensors(as_other_entries(TWO, "data.pkl", lambda _, new=larger: new), "here")
    # Nor many times as large, by repeating what is there
    repeated = re.sub(rb"KM(\x85q.)K\x01(?=\x85)", lambda found: b"J\x40\x42\x0f\x00" + found[1] + b"K\x00", program)
    with pytest.raises(ValueError, match=r"of shape \(1000000,\)"):
        check_tensors(as_other_entries(TWO, "data.pkl", lambda _: repeated), "here")


# -- trust and sizes ---------------------------------------------------------------------------------------------------


def test_trust_is_in_kinds_of_classes_of_known_packages():
    for known in ("sb3_belief.belief_ppo", "stable_baselines3", "sb3_contrib.qrdqn.policies", "torch.nn.modules.linear"):
        assert UNTRUSTED.allowed(known)
    for unknown in ("os", "torch", "torch.nnx", "stable_baselines3x", "tests.x", "__main__", "numpy"):
        assert not UNTRUSTED.allowed(unknown)
    for kind in (PPO.policy_aliases["MlpPolicy"], ReplayBuffer, th.nn.ReLU, th.optim.Adam, spaces.Box, LinearSchedule):
        assert UNTRUSTED.accepts(kind)
    assert UNTRUSTED.accepts(TrainFreq) and UNTRUSTED.accepts(TrainFrequencyUnit)
    for other in (CSVOutputFormat, load_from_pkl, PPO.learn, th.nn.functional.relu):
        assert not UNTRUSTED.accepts(other)


def test_trust_in_packages_of_ones_own():
    mine = Trust.of(False, ["tests"])
    assert mine.allowed("tests.x") and not mine.allowed("tests2") and mine.accepts(saved) and not mine.accepts(load_from_pkl)
    everything = Trust.of(True, ())
    assert everything.allowed("os") and everything.accepts(load_from_pkl)
    wrong: Any
    for wrong in ("tests", [1]):
        with pytest.raises(TypeError, match="must be a list of names of packages"):
            Trust.of(False, wrong)


@pytest.mark.parametrize(
    "settings",
    [
        spaces.Discrete(10**9),
        {"x": [spaces.Dict({"a": spaces.Tuple([spaces.MultiDiscrete([5, 10**9])])})]},
        spaces.MultiBinary(10**8),
        {"net_arch": [10**9]},
        {"policy_kwargs": {"net_arch": {"pi": [64, 64], "qf": [2**14, 2**14]}}},
        {"net_arch": [2000, 2000, {"vf": [5]}]},
    ],
)
def test_sizes_that_a_file_cannot_be_true_of_are_refused(settings):
    with pytest.raises(ValueError, match="which a file of 1,000,000 bytes has no weights for"):
        check_sizes(settings, 10**6)


def test_usual_sizes_are_accepted():
    box = spaces.Box(0, 255, (84, 84, 4), np.uint8)
    usual = {
        "observation_space": box,
        "net_arch": dict(pi=[256, 256], vf=[256]),
        "n_steps": 10**9,
        "action": spaces.Discrete(9),
    }
    check_sizes(usual, 600_000)
