"""Programs in processes of their own are compared, with tiny programs in place of the libraries."""

import json
import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks import strength
from benchmarks.peers import __main__ as peers
from benchmarks.peers.ours_strength import ENV, settings_of
from benchmarks.peers.programs import Program
from benchmarks.peers.spread_settings import OFF_POLICY, ON_POLICY, OffPolicy, OnPolicy
from sb3_belief.zoo.config import load_config

# Writes its name to a file at each iteration, which shows the order of the iterations
CHILD = """
import json, sys, time
name, order, dies_after = sys.argv[1], sys.argv[2], int(sys.argv[3])
print("a library talks", file=sys.stderr)
turns = 0
while True:
    with open(order, "a") as file:
        file.write(name + " ")
    end = time.process_time() + 0.05
    while time.process_time() < end:
        pass
    if turns == dies_after:
        raise ValueError("no more of " + name)
    first = {"versions": {"fake": "1.0"}, "work": {"joint_steps": 7}}
    print(json.dumps({"steps": 10, **(first if turns == 0 else {})}), flush=True)
    turns += 1
    if not sys.stdin.readline():
        break
"""


@pytest.fixture
def make(tmp_path):
    def program(name: str, dies_after: int = -1) -> Program:
        return Program(name, [sys.executable, "-c", CHILD, name, str(tmp_path / "order"), str(dies_after)])

    return program


def test_programs_take_turns_and_one_that_dies_is_skipped(make, tmp_path, capsys):
    report = peers.PeerReport(rounds=3, quick=True, ratios={})
    rivals = {"rival": make("rival"), "dies": make("dies", dies_after=2), "never": make("never", dies_after=0)}
    rivals["missing"] = Program("missing", [str(tmp_path / "nowhere" / "python")])
    peers.compare(report, {"ippo": make("ippo")}, rivals, make("env"))
    out = tmp_path / "out" / "peers.json"
    report.write(out)

    order = (tmp_path / "order").read_text().split()
    # Each is warmed up first; then they take turns back and forth, without those that have died
    assert order[:5] == ["ippo", "rival", "dies", "never", "env"]
    assert order[5:] == ["ippo", "rival", "dies", "env", "env", "dies", "rival", "ippo", "ippo", "rival", "env"]
    written = json.loads(out.read_text())
    assert written["skipped"]["dies"] == "ValueError: no more of dies"
    assert written["skipped"]["never"] == "ValueError: no more of never"
    assert "nowhere" in written["skipped"]["missing"]
    assert written["programs"].keys() == {"ippo", "rival", "env"}
    assert written["programs"]["rival"]["versions"] == {"fake": "1.0"}
    assert written["programs"]["rival"]["work"] == {"joint_steps": 7}
    assert all(0 <= about["idle_share_of_a_core"] < 0.5 for about in written["programs"].values())
    assert [row["steps"] for row in written["details"]["rows"]] == [[10] * 3] * 3
    assert written["ratios"]["ippo_vs_best_peer"] == written["ratios"]["ippo_vs_rival"] > 0
    assert written["ratios"].keys() == {"ippo_vs_best_peer", "ippo_vs_rival", "ippo_vs_best_peer_wall"}
    printed = capsys.readouterr().out
    assert "dies: skipped: ValueError: no more of dies" in printed
    assert "bar >= 2: " in printed


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="CPU time of other processes comes from /proc")
def test_the_time_of_a_turn_includes_the_processes_that_the_program_started(tmp_path):
    burns = "import time\nend = time.process_time() + 0.2\nwhile time.process_time() < end: pass"
    child = f"""
import subprocess, sys
print('{{"steps": 1}}', flush=True)
while sys.stdin.readline():
    subprocess.run([sys.executable, "-c", {burns!r}])
    print('{{"steps": 1}}', flush=True)
"""
    program = Program("burns", [sys.executable, "-c", child])
    program.start()
    try:
        assert program.turn() == 1
    finally:
        program.stop()
    assert program.error is None
    assert program.samples[0].cpu >= 0.19
    assert program.samples[0].wall >= 0.19


def test_a_program_that_does_not_answer_is_ended():
    program = Program("hangs", [sys.executable, "-c", "import time; time.sleep(60)"], seconds=0.2)
    program.start()
    assert program.error == "no answer in time: it ended without a message"
    assert program.turn() == 0 and program.samples == []
    program.stop()


def test_a_library_without_its_environment_says_why(tmp_path, monkeypatch):
    monkeypatch.setattr(peers, "VENVS", tmp_path)
    assert peers.peer("RLlib", "rllib").error == "not installed, see make bench-peers"
    (tmp_path / "rllib.log").write_text("Collecting ray\nERROR: no such version\n")
    program = peers.peer("RLlib", "rllib")
    assert program.error == "not installed: ERROR: no such version"
    program.start()
    assert program.samples == []


def test_what_was_trained_is_kept_and_compared(tmp_path, monkeypatch, capsys):
    program = (
        "import json, sys; print('talks'); print(json.dumps({'returns': [float(sys.argv[3]) - 10, -8.0], 'seconds': 3.0}))"
    )
    starts = []

    def run(words, **kwargs):
        starts.append(words)
        return subprocess.run([words[0], "-c", program, *words[3:]], **kwargs)

    monkeypatch.setattr(strength, "subprocess", SimpleNamespace(run=run))
    monkeypatch.setattr(
        strength, "LIBRARIES", {name: (Path(sys.executable), f"some.{name}") for name in ("ours", "BenchMARL")}
    )
    words = ["strength", "--algorithms", "ippo", "--seeds", "2", "--steps", "50", "--folder", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", words)
    strength.main()
    assert [(line[2], line[3:]) for line in starts] == [
        (f"some.{library}", ["ippo", "--seed", str(seed), "--steps", "50"])
        for seed in (0, 1)
        for library in ("ours", "BenchMARL")
    ]
    first = capsys.readouterr().out
    # The means of two episodes: -9 with seed 0, -8.5 with seed 1
    assert "| `ippo` | -8.75 (" in first and "| 3; 3 |" in first and "ours ippo, seed 0: -9.00" in first
    strength.main()
    assert len(starts) == 4 and capsys.readouterr().out == first[first.index("| |") :]


def test_both_libraries_train_with_the_same_settings():
    for algorithm in (*ON_POLICY, *OFF_POLICY):
        config = load_config(algorithm, ENV, overrides=[("benchmarks", settings_of(algorithm, 1000))])
        assert (config.n_timesteps, config.n_envs) == (1000, 32 if algorithm in ON_POLICY else 8)
        assert config.algo_kwargs["gamma"] == 0.95 and config.algo_kwargs["max_grad_norm"] == 10
    source = (Path(strength.__file__).parent / "peers" / "benchmarl_strength.py").read_text()
    # Its environment has no sb3_belief, so it cannot be imported here: each of the shared settings is used in it
    for name in (*(each.name for each in fields(OnPolicy)), *(each.name for each in fields(OffPolicy))):
        assert re.search(rf"\b(on|off|work)\.{name}\b", source), name
