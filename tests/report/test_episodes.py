import sys

import numpy as np
import pytest

pa = pytest.importorskip("pyarrow", reason="pip install 'sb3-belief[study]'")

from sb3_belief.report.episodes import EPISODES, curves, read_episodes_table, scores, write_episodes_table  # noqa: E402


def row(**changes):
    return {
        "study": "junction",
        "arm": "dynamic",
        "algorithm": "belief_ppo",
        "environment": "traffic-junction-easy",
        "seed": 0,
        "phase": "final",
        "checkpoint": "best",
        "deterministic": True,
        "joint_steps": 1000,
        "episode": 0,
        "episode_return": -1.5,
        "success": 1.0,
        "length": 20,
        **changes,
    }


def table(*rows):
    return pa.Table.from_pylist([row(**each) for each in rows], schema=EPISODES)


SOME = [
    {"episode_return": 0.1 + 0.2},
    {"episode": 1, "success": None, "arm": 'a, "b" and ü'},
    {"seed": 1, "episode_return": float("nan")},
    {"phase": "training", "checkpoint": "current", "joint_steps": 500, "episode_return": -1e-300},
    {"deterministic": False, "study": "007"},
]


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_what_is_written_is_read_bit_for_bit(tmp_path, suffix):
    path = write_episodes_table(table(*SOME), tmp_path / f"episodes{suffix}")
    read = read_episodes_table(path)
    assert read.schema.equals(EPISODES)
    # NaN is not equal to itself
    np.testing.assert_array_equal(read["episode_return"].to_numpy(), table(*SOME)["episode_return"].to_numpy())
    assert read.drop_columns("episode_return").equals(table(*SOME).drop_columns("episode_return"))
    assert [each.name for each in tmp_path.iterdir()] == [path.name]


def test_files_of_both_kinds_are_joined_in_order(tmp_path):
    first = write_episodes_table(table({}), tmp_path / "a.parquet")
    second = write_episodes_table(table({"seed": 1}, {"seed": 2}), tmp_path / "b.csv")
    assert read_episodes_table([first, str(second)])["seed"].to_pylist() == [0, 1, 2]
    assert read_episodes_table([]).schema.equals(EPISODES)


def test_folders_named_like_partitions_add_no_column(tmp_path):
    folder = tmp_path / "lr=0.1"
    folder.mkdir()
    assert read_episodes_table(write_episodes_table(table({}), folder / "episodes.parquet")).schema.equals(EPISODES)


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.5, 0.9, 0.999])
def test_a_file_that_was_cut_is_refused_in_one_line_with_its_path(tmp_path, suffix, share):
    path = write_episodes_table(table(*({"episode": each} for each in range(100))), tmp_path / f"episodes{suffix}")
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(ValueError, match=r"episodes\.\w+: is damaged \(.*\): write it again or leave it out") as caught:
        read_episodes_table(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def test_other_columns_are_refused(tmp_path):
    path = tmp_path / "other.csv"
    path.write_text("arm,speed\nx,1\n")
    with pytest.raises(
        ValueError, match=r"other\.csv: lacks study, algorithm, .* and has also speed: the columns of episodes"
    ):
        read_episodes_table(path)
    with pytest.raises(ValueError, match=r"a\.csv: lacks length: the columns"):
        write_episodes_table(table({}).drop_columns("length"), tmp_path / "a.csv")
    assert not (tmp_path / "a.csv").exists()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"phase": "trained"}, "checkpoint 'best' in phase 'trained'; there are training: current; final: last, best"),
        ({"checkpoint": "current"}, "checkpoint 'current' in phase 'final'"),
        ({"success": 2.0}, r"success goes from 2\.0 to 2\.0; it must be between 0 and 1"),
    ],
)
def test_values_that_are_not_allowed_are_refused(tmp_path, changes, words):
    with pytest.raises(ValueError, match=f"a.parquet: .*{words}"):
        write_episodes_table(table(changes), tmp_path / "a.parquet")


def test_missing_values_and_values_of_another_type_are_refused(tmp_path):
    path = write_episodes_table(table({}), tmp_path / "a.csv")
    text = path.read_text()
    for old, new in [("-1.5", ""), ('"dynamic"', ""), ("-1.5", "much")]:
        path.write_text(text.replace(old, new))
        with pytest.raises(ValueError, match=r"a\.csv: "):
            read_episodes_table(path)
    with pytest.raises(FileNotFoundError, match=r"b\.csv: there is no such file of episodes"):
        read_episodes_table(tmp_path / "b.csv")
    with pytest.raises(ValueError, match=r"b\.json: episodes are in files whose names end in \.parquet or \.csv"):
        write_episodes_table(table({}), tmp_path / "b.json")


def test_doubled_episodes_are_refused(tmp_path):
    whole = write_episodes_table(table({}, {"episode": 1}), tmp_path / "whole.parquet")
    cell = write_episodes_table(table({"episode_return": 3.0}), tmp_path / "cell.csv")
    with pytest.raises(ValueError, match=r"whole\.parquet, .*cell\.csv: the episode with .*seed 0.* is there more than once"):
        read_episodes_table([whole, cell])
    with pytest.raises(ValueError, match="and 1 more are there more than once"):
        read_episodes_table([whole, whole])


def test_scores_are_means_over_the_final_episodes_of_each_run():
    episodes = table(
        {"seed": 3, "episode_return": 1.0, "success": 0.0},
        {"seed": 3, "episode_return": 4.0, "episode": 1},
        {"seed": 1, "episode_return": 7.0},
        {"seed": 1, "episode_return": 8.0, "checkpoint": "last"},
        {"seed": 1, "episode_return": 9.0, "deterministic": False},
        {"seed": 1, "episode_return": 5.0, "phase": "training", "checkpoint": "current", "joint_steps": 10},
        {"seed": 1, "episode_return": 6.0, "phase": "training", "checkpoint": "current", "joint_steps": 20},
        {"seed": 1, "episode_return": 2.0, "arm": "ippo", "environment": "quiet", "success": None},
    )
    junction = "traffic-junction-easy"
    assert scores(episodes) == {junction: {"dynamic": {1: 7.0, 3: 2.5}}, "quiet": {"ippo": {1: 2.0}}}
    assert list(scores(episodes)[junction]["dynamic"]) == [1, 3]
    assert scores(episodes, "success") == {junction: {"dynamic": {1: 1.0, 3: 0.5}}}
    assert scores(episodes, checkpoint="last") == {junction: {"dynamic": {1: 8.0}}}
    assert scores(episodes, checkpoint="current") == {junction: {"dynamic": {1: 6.0}}}
    assert scores(episodes, deterministic=False) == {junction: {"dynamic": {1: 9.0}}}
    assert scores(EPISODES.empty_table()) == {}


@pytest.mark.parametrize(
    ("rows", "arguments", "words"),
    [
        ([{}], {"quantity": "wins"}, "quantity is 'wins'; it must be one of 'return', 'success'"),
        ([{}], {"checkpoint": "first"}, "checkpoint is 'first'; it must be one of 'current', 'last', 'best'"),
        ([{"success": None}], {"quantity": "success"}, "No environment reports successes"),
        ([{}, {"episode": 1, "success": None}], {"quantity": "success"}, "Only 1 of 2 episodes on 'traffic-junction-easy'"),
        ([{}, {"joint_steps": 2}], {}, "final evaluations of 'best' weights after 2, 1000 joint steps: keep one"),
        ([{"episode_return": np.nan}], {}, "Seed 0 of 'dynamic' .* has a mean return of nan"),
        ([{}, {"study": "b", "seed": 1}], {}, "Studies 'junction', 'b' all hold 'dynamic' on 'traffic-junction-easy'"),
    ],
)
def test_scores_that_would_mislead_are_refused(rows, arguments, words):
    with pytest.raises(ValueError, match=words):
        scores(table(*rows), **arguments)


def test_curves_have_a_row_for_each_seed_and_gaps_where_it_was_not_evaluated():
    training = {"phase": "training", "checkpoint": "current"}
    episodes = table(
        {"seed": 2, "joint_steps": 20, "episode_return": 5.0, **training},
        {"seed": 0, "joint_steps": 10, "episode_return": 1.0, **training},
        {"seed": 0, "joint_steps": 10, "episode_return": 2.0, "episode": 1, **training},
        {"seed": 2, "joint_steps": 10, "episode_return": 3.0, **training},
        {"seed": 0, "episode_return": 9.0},
    )
    steps, values, seeds = curves(episodes)["traffic-junction-easy"]["dynamic"]
    np.testing.assert_array_equal(steps, [10, 20])
    np.testing.assert_array_equal(values, [[1.5, np.nan], [3.0, 5.0]])
    assert seeds == [0, 2]


def test_without_pyarrow_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.delitem(sys.modules, "sb3_belief.report.episodes")
    with pytest.raises(ImportError, match=r"Tables of episodes need pyarrow: pip install 'sb3-belief\[study\]'"):
        import sb3_belief.report.episodes  # noqa: F401
