"""The benchmarks run and count right; how fast anything is, is never asserted."""

import json
from pathlib import Path

import pytest
import torch as th

from benchmarks import bench, gpu, heavy, stacked
from benchmarks.measure import Sample, alternate, cores, ratio, spread
from benchmarks.report import BARS, Report

AGENT_STEPS = 32


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> dict:
    out = tmp_path_factory.mktemp("bench") / "out" / "bench.json"
    bench.main(["--quick", "--parts", "a", "b", "c", "together", "d", "cores", "--out", str(out)])
    return json.loads(Path(out).read_text())


def test_the_file_says_all_that_others_read(written):
    assert written.keys() == {"ratios", "peak_mib", "versions", "details"}
    assert written["ratios"].keys() == BARS.keys()
    # these two are measured in parts that were not asked for, or not everywhere
    unmeasured = {"workers_vs_ideal", "two_cores_vs_one"}
    assert all(value > 0 for key, value in written["ratios"].items() if key not in unmeasured)
    assert written["versions"]["torch"]
    assert written["details"]["quick"] is True
    for part in ("a", "b"):
        time = written["details"]["time"][part]
        assert time["belief_share_of_update"] < 1
        for parts in time["ms_per_joint_step"].values():
            assert {"environment", "transfer", "policy", "buffer", "update: backward", "rest"} <= parts.keys()
            total = parts.pop("total")
            assert sum(parts.values()) == pytest.approx(total)


def test_steps_are_counted_as_they_were_done(written):
    rows = {(row["part"], row["name"]): row["steps"] for row in written["details"]["rows"]}
    spread_rows = [steps for (part, _), steps in rows.items() if part == "a"]
    assert spread_rows == [[8 * 8]] * 5
    junction_rows = [steps for (part, _), steps in rows.items() if part == "b"]
    assert junction_rows == [[4 * 8]] * 2
    # What lies between the 8 steps of a rollout, by turns
    together = [steps for (part, _), steps in rows.items() if part == "together"]
    assert together == [[8] * n for n in (3, 4, 3, 4)] + [[4] * n for n in (3, 4, 3, 4)]
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
    # the machine was half as fast in the second round, for both
    fast, slow = [Sample(100, 1.0, 2.0), Sample(100, 2.0, 4.0)], [Sample(100, 2.0, 2.0), Sample(100, 4.0, 4.0)]
    assert ratio(fast, slow) == (2.0, 2.0, 2.0)
    assert ratio(fast, slow, "wall") == (1.0, 1.0, 1.0)
    assert spread([4.0, 1.0, 2.0, 3.0, 5.0]) == (3.0, 2.0, 4.0)


def test_updates_are_timed_by_themselves():
    report = Report(rounds=1, quick=True)
    gpu.run(report, ("cpu", "cpu"))
    for way in ("lockstep", "stacked"):
        assert report.ratio_rows[f"gpu_one_by_one_vs_{way}"]["median"] > 0
    assert report.time["update on cpu"]["ms_per_minibatch_of_all_agents"] > 0
    assert report.ratio_rows["gpu_vs_cpu_update"]["median"] > 0


@pytest.mark.parametrize("way", [stacked.Stacked, stacked.InLockstep])
def test_a_stacked_step_is_that_of_each_agent(way):
    th.manual_seed(0)
    policies = [stacked.make_policy("cpu") for _ in range(3)]
    batches = [stacked.make_batch(16, "cpu") for _ in policies]
    together, apart = way(policies, batches), stacked.OneByOne(policies, batches)
    before = apart.weights()
    together.steps(2)
    apart.steps(2)
    found, expected = together.weights(), apart.weights()
    assert found.keys() == expected.keys()
    for name, weights in expected.items():
        th.testing.assert_close(found[name], weights, rtol=0, atol=1e-6)
        assert (weights - before[name]).abs().amax(dim=tuple(range(1, weights.dim()))).min() > 1e-4


@pytest.mark.skipif(th.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_it_is_said_that_there_is_none():
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
    import time

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
    # Nobody takes less time than it takes
    assert written["details"]["ratios"]["workers_sleeps_bare"]["median"] < 1
