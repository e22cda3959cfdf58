"""Files of strangers: what is damaged or changed is refused, what is large is not unpacked, and ours need no pickle."""

import io
import json
import os
import random
import subprocess
import sys
import zipfile
import zlib
from pathlib import Path

import pytest

from sb3_belief import BeliefPPO
from sb3_belief.common.safe_files.models import NamedContent
from tests.archives import changed, changed_json
from tests.reliability.fuzz import NAME, load_agent, load_team, mutated, saved_files
from tests.team.helpers import Team

ROOT = Path(__file__).parents[2]
GB = 10**9


def in_child(*words, **kwargs):
    """Run Python in a process of its own, and return what it prints."""
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-W", "ignore", *words]
    done = subprocess.run(command, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, **kwargs)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def files():
    return saved_files()


def check_fuzz(count, seed):
    found = json.loads(in_child("-m", "tests.reliability.fuzz", str(count), str(seed)))
    assert found["outcomes"].keys() <= {"refused", "the same"}, found
    # A few changes concern what nobody reads, such as the date of a member
    assert found["outcomes"]["refused"] > 0.9 * count and sum(found["outcomes"].values()) == count
    assert found["memory"] < GB


def test_mutated_files_are_refused_with_their_name():
    check_fuzz(400, 0)


@pytest.mark.slow
def test_ten_thousand_mutated_files_are_refused_with_their_name():
    check_fuzz(10_000, 1)


def test_whole_files_are_not_refused(files):
    # Otherwise the above would hold for a program that refuses everything
    team, alone = files
    assert load_team(team) == load_team(team) and load_agent(alone) == load_agent(alone)
    assert load_team(team) != load_team(changed("team.json", changed_json(num_timesteps=3))(team))


@pytest.mark.parametrize("seed", range(3))
def test_changes_whose_author_signed_them_raise_no_other_error(files, seed):
    team, _ = files
    rng = random.Random(seed)
    names = ["data", "sb3_belief.json", "sb3_belief.bin", "policy.pth", "policy.optimizer.pth"]
    for _ in range(30):
        changed_inside = changed(rng.choice(names), lambda old: mutated(old, rng))
        content = changed("agents/agent_0.zip", changed_inside)(team)
        try:
            Team.load(NamedContent(content, NAME), device="cpu")
        except (ValueError, TypeError) as error:
            notes = " ".join([str(error), *getattr(error, "__notes__", [])])
            assert NAME in notes and "agent_0" in notes


def bomb(name: str, size: int, declared: int) -> bytes:
    """Return a zip with a member of so many zeros, whatever size it claims."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    # After a full flush the packer begins anew, so each megabyte is packed to the same bytes
    chunk = packer.compress(bytes(2**20)) + packer.flush(zlib.Z_FULL_FLUSH)
    packed = chunk * (size // 2**20) + packer.flush()
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr(name, packed)
        archive.writestr("SHA256SUMS", f"{'0' * 64} {declared} {name}\n")
    content = bytearray(file.getvalue())
    central = content.index(b"PK\1\2")
    for method, length in ((8, 22), (central + 10, central + 24)):
        content[method : method + 2] = (8).to_bytes(2, "little")
        content[length : length + 4] = declared.to_bytes(4, "little")
    return bytes(content)


MEASURED = """
import resource, sys
from sb3_belief.team import Team
from sb3_belief import BeliefPPO
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for path in sys.argv[1:]:
    for load in (Team.load, BeliefPPO.load):
        try:
            load(path)
        except ValueError as error:
            print(error)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024)
"""


def test_three_megabytes_that_unpack_to_three_gigabytes_are_refused(tmp_path):
    members = [("team.json", 3 * GB), ("team.json", 1000), ("data", 3 * GB), ("agents/agent_0.zip", 3 * GB)]
    paths = [tmp_path / f"bomb_{number}.zip" for number in range(len(members))]
    for path, (name, declared) in zip(paths, members, strict=True):
        content = bomb(name, 3 * 2**30, declared)
        assert 2_000_000 < len(content) < 4_000_000
        path.write_bytes(content)
    # In one process, since what it imports takes longer than all of them
    *said, memory = in_child("-c", MEASURED, *map(str, paths)).splitlines()
    assert len(said) == 2 * len(paths) and int(memory) < 200_000_000
    for number, path in enumerate(paths):
        lines = said[2 * number : 2 * number + 2]
        assert all(path.name in line for line in lines)
        assert any("is compressed, which this package does not do" in line for line in lines)


def test_json_that_is_all_brackets_is_refused_before_it_is_read(files, tmp_path):
    team, _ = files
    # A list of two bytes takes 60 in memory
    content = changed("team.json", lambda _: b"[" + b"[]," * 4_000_000 + b"[]]")(team)
    (tmp_path / "bomb.zip").write_bytes(content)
    *said, memory = in_child("-c", MEASURED, str(tmp_path / "bomb.zip")).splitlines()
    assert "member 'team.json': it has 8,000,002 parts" in said[0]
    assert int(memory) < 150_000_000


BLOCKED = """
import pickle, _pickle, cloudpickle, sys
# It derives classes from pickle.Unpickler
import torch._dynamo
from sb3_belief import BeliefPPO
from sb3_belief.team import Team
from sb3_belief.team.fixed_partners.partners import load_model

def blocked(*args, **kwargs):
    raise AssertionError("something was unpickled")

for module in (pickle, _pickle, cloudpickle):
    for name in ("load", "loads", "Unpickler", "_Unpickler", "_load", "_loads"):
        if hasattr(module, name):
            setattr(module, name, blocked)
# Also where a module has taken one of them by name
sys.addaudithook(lambda event, args: blocked() if event == "pickle.find_class" else None)

team = Team.load("team.zip", device="cpu")
assert team._agents.statistics.keys() == {"agent_0", "agent_1"}
model, statistics = load_model("team.zip", "agent_1")
print(sum(float(value.sum()) for value in model.policy.state_dict().values()), statistics.obs_rms.mean.sum())
print(sum(float(value.sum()) for value in BeliefPPO.load("alone.zip", device="cpu").policy.state_dict().values()))
load_model("alone.zip", "")
"""


def test_ours_load_where_nothing_can_be_unpickled(files, tmp_path):
    for name, content in zip(("team.zip", "alone.zip"), files, strict=True):
        (tmp_path / name).write_bytes(content)
    first, second = in_child("-c", BLOCKED, cwd=tmp_path).splitlines()
    team, alone = Team.load(tmp_path / "team.zip", device="cpu"), BeliefPPO.load(tmp_path / "alone.zip", device="cpu")
    weights = team.agents["agent_1"].policy.state_dict().values()
    expected = sum(float(value.sum()) for value in weights), team._agents.statistics["agent_1"].obs_rms.mean.sum()
    assert first == f"{expected[0]} {expected[1]}"
    assert second == str(sum(float(value.sum()) for value in alone.policy.state_dict().values()))
