import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest

from sb3_belief.report.episodes import EPISODES, curves, scores
from sb3_belief.report.marl_eval import marl_eval_data, write_marl_eval
from tests.report.peers import run_with

ARMS, TASKS, SEEDS, STEPS = ("ippo", "Dynamic"), ("junction-easy", "junction-hard"), (0, 3, 7), (100, 200)


def episodes():
    """A small study: two arms, two environments, three seeds, two evaluations of 4 episodes, final ones of 40."""
    rng = np.random.default_rng(5)
    rows = []
    for arm in ARMS:
        for task in TASKS:
            for seed in SEEDS:
                evaluations = [("training", "current", True, step, 4) for step in STEPS]
                evaluations += [("final", name, greedy, 200, 40) for name in ("last", "best") for greedy in (True, False)]
                for phase, checkpoint, greedy, step, count in evaluations:
                    for episode in range(count):
                        value = float(rng.normal(ARMS.index(arm) + 10 * TASKS.index(task)))
                        key = ("junction", arm, "ppo", task, seed, phase, checkpoint, greedy, step, episode)
                        rows.append((*key, value, float(value > 1), 20))
    return pa.Table.from_pylist([dict(zip(EPISODES.names, row, strict=True)) for row in rows], schema=EPISODES)


TABLE = episodes()


def without(condition):
    return TABLE.filter(~condition)


def test_the_format_is_that_of_the_readme():
    data = marl_eval_data(TABLE)
    assert list(data) == ["junction"] and list(data["junction"]) == list(TASKS)
    for task in TASKS:
        assert list(data["junction"][task]) == list(ARMS)
        for arm in ARMS:
            runs = data["junction"][task][arm]
            assert list(runs) == ["seed_0", "seed_3", "seed_7"]
            for seed in SEEDS:
                run = runs[f"seed_{seed}"]
                assert list(run) == ["step_1", "step_2", "absolute_metrics"]
                for index, step in enumerate(STEPS):
                    at = run[f"step_{index + 1}"]
                    assert list(at) == ["step_count", "return", "success"] and at["step_count"] == step
                    assert len(at["return"]) == len(at["success"]) == 4
                    _, values, seeds = curves(TABLE)[task][arm]
                    assert np.mean(at["return"]) == pytest.approx(values[seeds.index(seed), index], rel=1e-12)
                for quantity in ("return", "success"):
                    assert len(run["absolute_metrics"][quantity]) == 40
                    score = scores(TABLE, quantity)[task][arm][seed]
                    assert np.mean(run["absolute_metrics"][quantity]) == pytest.approx(score, rel=1e-12)


def test_what_is_exported_can_be_chosen():
    task, arm = TASKS[0], ARMS[1]
    for checkpoint in ("last", "best"):
        for greedy in (True, False):
            run = marl_eval_data(TABLE, checkpoint=checkpoint, deterministic=greedy)["junction"][task][arm]["seed_3"]
            expected = scores(TABLE, "return", checkpoint, greedy)[task][arm][3]
            assert np.mean(run["absolute_metrics"]["return"]) == pytest.approx(expected, rel=1e-12)
            assert len(run["step_1"]["return"]) == 4
    apart = marl_eval_data(TABLE, suites={TASKS[1]: "hard"})
    assert {suite: list(tasks) for suite, tasks in apart.items()} == {"junction": [TASKS[0]], "hard": [TASKS[1]]}


def test_successes_that_one_environment_does_not_report_are_left_out():
    none = pa.nulls(len(TABLE), pa.float64())
    successes = pc.if_else(pc.equal(TABLE["environment"], TASKS[0]), none, TABLE["success"])
    table = TABLE.set_column(TABLE.column_names.index("success"), EPISODES.field("success"), successes)
    run = marl_eval_data(table)["junction"][TASKS[1]][ARMS[0]]["seed_0"]
    assert list(run["absolute_metrics"]) == ["return"] and list(run["step_1"]) == ["step_count", "return"]


def test_an_evaluation_that_one_run_has_not_had_is_left_out_for_all():
    late = (pc.field("joint_steps") == 200) & (pc.field("phase") == "training") & (pc.field("seed") == 3)
    data = marl_eval_data(
        without(late & (pc.field("arm") == "ippo") & (pc.field("environment") == TASKS[0])),
        suites=dict(zip(TASKS, "ab", strict=True)),
    )
    assert {len(run) for run in data["a"][TASKS[0]]["Dynamic"].values()} == {2}
    assert {len(run) for run in data["b"][TASKS[1]]["Dynamic"].values()} == {3}


@pytest.mark.parametrize(
    ("table", "words"),
    [
        (without((pc.field("seed") == 3) & (pc.field("arm") == "Dynamic")), r"needs the same runs everywhere: .*\[0, 3, 7\]"),
        (
            without((pc.field("arm") == "ippo") & (pc.field("environment") == TASKS[1])),
            "needs the same algorithms in all tasks",
        ),
        (without((pc.field("joint_steps") == 100) & (pc.field("environment") == TASKS[1])), "needs equally many evaluations"),
        (without(pc.field("phase") == "training"), "have no evaluation while training in common"),
        (without(pc.field("phase") == "final"), "There are no final episodes of 'best' weights"),
    ],
)
def test_gaps_are_refused(table, words):
    with pytest.raises(ValueError, match=words):
        marl_eval_data(table)


@pytest.mark.parametrize(
    ("name", "words"), [("IPPO", "makes all names lower case: rename 'ippo' or 'IPPO'"), ("a,b", "no comma .* rename 'a,b'")]
)
def test_names_that_marl_eval_cannot_take_are_refused(name, words):
    arms = pc.if_else(pc.equal(TABLE["arm"], "Dynamic"), name, TABLE["arm"])
    with pytest.raises(ValueError, match=words):
        marl_eval_data(TABLE.set_column(1, EPISODES.field("arm"), arms))


@pytest.mark.slow
def test_marl_eval_itself_reads_it(tmp_path):
    path = write_marl_eval(TABLE, tmp_path / "junction.json")
    read = json.loads(run_with("marl_eval", Path(__file__).with_name("read_marl_eval.py"), str(path)))
    assert read["checks"] == {
        "junction": {f"valid_{each}": True for each in ("algorithms", "algorithm_names", "runs", "steps", "metrics")}
    }
    final, of_training = read["found"]["junction"]["final"], read["found"]["junction"]["curves"]
    for arm in ARMS:
        expected = [[scores(TABLE, "success")[task][arm][seed] for task in TASKS] for seed in SEEDS]
        np.testing.assert_allclose(final["mean_success"][arm.lower()], expected, rtol=1e-12)
        of_curves = np.stack([curves(TABLE, "success")[task][arm][1] for task in TASKS], axis=1)
        np.testing.assert_allclose(of_training["mean_success"][arm.lower()], of_curves, rtol=1e-12)
        # It normalises returns by the lowest and highest single episode of a task
        for column, task in enumerate(TASKS):
            chosen = TABLE.filter((pc.field("environment") == task) & pc.field("deterministic"))
            chosen = chosen.filter(pc.field("checkpoint") != "last")["episode_return"].to_numpy()
            own = np.array([scores(TABLE)[task][arm][seed] for seed in SEEDS])
            own = (own - chosen.min()) / (chosen.max() - chosen.min() + 1e-6)
            np.testing.assert_allclose(np.array(final["mean_norm_return"][arm.lower()])[:, column], own, rtol=1e-9)
