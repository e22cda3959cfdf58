"""Programs in processes of their own are compared, with tiny programs in place of the libraries."""

import json
import sys
from pathlib import Path

import pytest

from benchmarks.peers import __main__ as peers
from benchmarks.peers.programs import Program

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
