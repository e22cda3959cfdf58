"""The benchmarks run and count right. How fast anything is, is never asserted."""

import json
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch as th

from benchmarks import acting, attention, batched_envs, bench, gpu, heavy, teams
from benchmarks.measure import Sample, alternate, cores, ratio, spread, take
from benchmarks.report import BARS, Report
from benchmarks.teams import PHASES, TeamLoop, junction_team, milliseconds, spread_team, time_of

AGENT_STEPS = 32


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> dict:
    out = tmp_path_factory.mktemp("bench") / "out" / "bench.json"
    bench.main(
        [
            *("--quick", "--out", str(out), "--parts"),
            *("a", "b", "c", "together", "d", "cores", "finite", "checkpoints", "partners", "scripted", "adaptive"),
        ]
    )
    return json.loads(Path(out).read_text())


def test_the_file_says_all_that_others_read(written):
    assert written.keys() == {"ratios", "peak_mib", "versions", "details"}
    assert written["ratios"].keys() == BARS.keys()
    # These two are measured in parts that were not selected, or not on every machine
    unmeasured = {"workers_vs_ideal", "two_cores_vs_one"}
    assert all(value > 0 for key, value in written["ratios"].items() if key not in unmeasured)
    assert written["versions"]["torch"]
    assert written["details"]["quick"] is True
    for part in ("a", "b"):
        found = written["details"]["time"][part]
        assert found["belief_share_of_update"] < 1
        for parts in found["ms_per_joint_step"].values():
            total = parts.pop("total")
            assert parts.keys() == set(PHASES)
            assert all(value > 0 for value in parts.values())
            assert sum(parts.values()) == pytest.approx(total)


def test_steps_are_counted_as_they_were_done(written):
    rows = {(row["part"], row["name"]): row["steps"] for row in written["details"]["rows"]}
    spread_rows = [steps for (part, _), steps in rows.items() if part == "a"]
    assert spread_rows == [[8 * 8]] * 5
    junction_rows = [steps for (part, _), steps in rows.items() if part == "b"]
    assert junction_rows == [[4 * 8]] * 2
    together = [steps for (part, _), steps in rows.items() if part == "together"]
    assert together == [[8 * 8]] * 4 + [[4 * 8]] * 4
    # With one short call a state is kept in most of it
    assert 0 < written["ratios"]["checkpoints_vs_none"] < 1
    if cores() > 1:
        assert rows["cores", "1 job"] == rows["cores", "2 jobs"] == [3 * 4 * 8]
        assert rows["cores", "2 teams"] == [2 * 3 * 4 * 8]
    for n in (5, 20):
        for kind in ("fixed others", "all learn", "no belief"):
            assert rows["agents", f"{n} agents, {kind}"] == [n * AGENT_STEPS]
    for part, names in {
        "copies": ("1 copies", "8 copies"),
        "history": ("800 rows", "6400 rows"),
        "others": ("5 others", "40 others"),
    }.items():
        for name in names:
            assert rows[part, name] == [AGENT_STEPS]


def test_loops_take_turns_and_their_ratio_is_that_of_the_same_round():
    order = []

    def loop(name: str, steps: int) -> int:
        order.append(name)
        return steps

    samples = alternate({"a": lambda: loop("a", 2), "b": lambda: loop("b", 3)}, rounds=3, warmup=1)
    assert order == ["a", "b", "a", "b", "b", "a", "a", "b"]
    assert [sample.steps for sample in samples["b"]] == [3, 3, 3]
    # In the second round the machine was half as fast, for both loops
    fast, slow = [Sample(100, 1.0, 2.0), Sample(100, 2.0, 4.0)], [Sample(100, 2.0, 2.0), Sample(100, 4.0, 4.0)]
    assert ratio(fast, slow) == (2.0, 2.0, 2.0)
    assert ratio(fast, slow, "wall") == (1.0, 1.0, 1.0)
    assert spread([4.0, 1.0, 2.0, 3.0, 5.0]) == (3.0, 2.0, 4.0)


@pytest.mark.parametrize("rollouts", [1, 2])
def test_the_phases_of_a_loop_are_all_of_its_time(rollouts):
    loop = TeamLoop(spread_team("ippo", quick=True), rollouts)
    measured = take(loop)
    assert measured.steps == rollouts * 8 * 8
    (phases,) = loop.phases
    assert phases.keys() == set(PHASES)
    assert all(sample.steps == measured.steps and sample.cpu > 0 and sample.wall > 0 for sample in phases.values())
    # The two clocks are read one after the other, hence the tolerance
    for clock in ("cpu", "wall"):
        parts = sum(getattr(sample, clock) for sample in phases.values())
        assert parts == pytest.approx(getattr(measured, clock), rel=0.05, abs=0.005)


def test_time_is_added_to_the_phase_in_which_it_passes(monkeypatch):
    team = spread_team("ippo", quick=True)
    env: Any = team.get_env()
    models: list[Any] = list(team.agents.values())
    passed = {"cpu": 0.0, "wall": 0.0}
    clocks = SimpleNamespace(process_time=lambda: passed["cpu"], perf_counter=lambda: passed["wall"])
    monkeypatch.setattr(teams, "time", clocks)

    def slow(method, seconds):
        def call(*args):
            passed["wall"] += seconds
            passed["cpu"] += seconds / 4
            return method(*args)

        return call

    # Nothing else takes any time
    env.step = slow(env.step, 2.0)
    for model in models:
        model.train = slow(model.train, 50.0)
    loop = TeamLoop(team)
    loop()
    (environment,), (update,) = (time_of(loop.phases, name) for name in ("environment", "update"))
    assert (environment.wall, environment.cpu) == (8 * 2.0, 8 * 0.5)
    assert (update.wall, update.cpu) == (3 * 50.0, 3 * 12.5)
    (acting_time,) = time_of(loop.phases, "acting")
    assert acting_time.wall == acting_time.cpu == 0
    (rollout,) = time_of(loop.phases, "environment", "acting")
    assert rollout.wall == environment.wall
    assert milliseconds(loop.phases)["update"] == pytest.approx(1000 * 3 * 12.5 / update.steps)


@pytest.mark.parametrize("make", [spread_team, junction_team])
def test_acting_together_and_apart_learns_the_same(make):
    team, other = make("belief_ppo", True), make("belief_ppo", True)
    found = acting.compare(team, rollouts=2)
    assert [len(samples) for samples in found.values()] == [2, 2]
    loop = TeamLoop(other)
    for _ in range(4):
        loop()
    for agent, model in team.agents.items():
        for one, another in zip(model.policy.parameters(), other.agents[agent].policy.parameters(), strict=True):
            assert th.equal(one, another)
        assert not model.policy._forward_pre_hooks


def test_updates_are_timed_by_themselves():
    report = Report(rounds=1, quick=True)
    gpu.run(report, ("cpu", "cpu"))
    assert report.time["update on cpu"]["ms_per_minibatch_of_all_agents"] > 0
    assert report.ratio_rows["gpu_vs_cpu_update"]["median"] > 0


@pytest.mark.parametrize("way", [batched_envs.batched, batched_envs.one_by_one])
def test_steps_of_batched_and_of_single_copies_are_counted_alike(way):
    assert way("traffic-junction-easy", n_envs=2, n_steps=50)() == 100


def test_all_ways_of_attention_give_the_same():
    queries, keys, values = (th.randn(n, 8, dtype=th.double) for n in (6, 20, 20))
    selected = th.rand(6, 20).topk(4, dim=1).indices.sort(dim=1).values.int()
    expected = attention.attend(queries, keys, values, selected)
    for way in (attention.dense, attention.gathered):
        for one, another in zip(way(queries, keys, values, selected), expected, strict=True):
            th.testing.assert_close(one, another)
        assert attention.passes(way, (6, 20, 4, 8))() == 4


@pytest.mark.skipif(th.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_the_report_says_that_there_is_none():
    report = Report(rounds=1, quick=True)
    gpu.run(report)
    assert "no GPU" in report.skipped["gpu"] and "gpu_vs_cpu_update" not in report.ratio_rows


def test_a_bar_that_is_missed_fails_nothing(capsys):
    report = Report(rounds=1, quick=True)
    report.add_ratio("lockstep_vs_hand", spread([0.5]), "this / that")
    report.add_ratio("others_40_vs_5", spread([1.5]), "this / that")
    assert "0.500 (0.500 to 0.500)   bar >= 0.97: missed" in (printed := capsys.readouterr().out)
    assert "bar <= 1.5: met" in printed
    assert report.ratios["lockstep_vs_hand"] == 0.5 and report.ratios["ippo_vs_hand"] is None


def test_a_heavy_step_burns_its_own_time():
    env = heavy.HeavyEnv("burns")
    env.reset()
    start = time.process_time()
    env.step({"agent_0": 0, "agent_1": 0})
    assert time.process_time() - start >= heavy.SECONDS


@pytest.mark.slow
def test_memory_and_workers_are_measured(tmp_path):
    out = tmp_path / "bench.json"
    bench.main(["--quick", "--parts", "e", "workers", "--out", str(out)])
    written = json.loads(out.read_text())
    assert written["peak_mib"].keys() >= {"imports only", "junction belief_ppo"}
    assert all(value > 50 for value in written["peak_mib"].values())
    assert written["ratios"]["workers_vs_ideal"] > 0
    steps = {row["name"]: row["steps"] for row in written["details"]["rows"]}
    assert steps["burns, stepped"] == steps["sleeps, learning"] == steps["sleeps, bare"] == [2 * 4]
    # No process can be faster than the ideal
    assert written["details"]["ratios"]["workers_sleeps_bare"]["median"] < 1
