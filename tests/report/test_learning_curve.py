import json

import numpy as np
import pytest

from sb3_belief.report.learning_curve import binned, plot_learning_curve, read_episodes, read_monitor, smooth
from tests.study.folders import write_evaluations

HEADER = '#{"t_start": 0.0, "env_id": "Team"}\nr,l,t,is_success\n'


def test_smooth_is_the_mean_of_the_last_values():
    np.testing.assert_allclose(smooth(np.array([1.0, 2.0, 6.0, 8.0]), 2), [1.0, 1.5, 4.0, 7.0])
    np.testing.assert_allclose(smooth(np.array([1.0, 2.0, 6.0]), 10), [1.0, 1.5, 3.0])


def test_monitor_counts_joint_steps_and_successes(tmp_path):
    (tmp_path / "monitor.csv").write_text(HEADER + "-1.5,20,0.1,True\n-2.5,20,0.2,False\n0.0,5,0.3,True\n")
    steps, returns, successes = read_monitor(tmp_path)
    assert steps.tolist() == [20, 40, 45]
    assert returns.tolist() == [-1.5, -2.5, 0.0]
    assert successes.tolist() == [1, 0, 1]


def test_an_environment_may_report_no_successes(tmp_path):
    (tmp_path / "monitor.csv").write_text(HEADER + "-1.5,20,0.1,\n")
    assert np.isnan(read_monitor(tmp_path)[2]).all()


def drawn(figures):
    axes = figures[-1].axes[0]
    texts = [text.get_text() for text in axes.texts]
    return axes.get_xlabel(), axes.get_ylabel(), axes.get_lines(), texts


@pytest.fixture
def figures(monkeypatch):
    """Every figure that is saved."""
    figure_module = pytest.importorskip("matplotlib.figure")
    saved = []
    original = figure_module.Figure.savefig

    def savefig(self, *args, **kwargs):
        saved.append(self)
        return original(self, *args, **kwargs)

    monkeypatch.setattr(figure_module.Figure, "savefig", savefig)
    return saved


def test_the_curve_shows_successes_evaluations_and_bars(tmp_path, figures):
    rows = "".join(f"-1.0,20,{i / 10},{i >= 50}\n" for i in range(100))
    (tmp_path / "monitor.csv").write_text(HEADER + rows)
    write_evaluations(tmp_path, [1000, 2000], [[1.0], [2.0]], [[False], [True]])
    path = plot_learning_curve(tmp_path, tmp_path / "plots" / "curve.png", bars={"all gas": 0.31})
    assert path.read_bytes().startswith(b"\x89PNG")
    x_label, y_label, (curve, greedy, bar), texts = drawn(figures)
    assert (x_label, y_label, texts) == ("joint steps of the team", "success rate", ["all gas  0.31"])
    assert (curve.get_xdata()[-1], curve.get_ydata()[49], curve.get_ydata()[-1]) == (2000, 0.0, 1.0)
    assert list(greedy.get_ydata()) == [0.0, 1.0]
    assert list(bar.get_ydata()) == [0.31, 0.31]


def test_without_successes_the_curve_shows_returns(tmp_path, figures):
    (tmp_path / "monitor.csv").write_text(HEADER + "-1.5,20,0.1,\n-0.5,20,0.1,\n")
    plot_learning_curve(tmp_path, tmp_path / "curve.png")
    _, y_label, (curve,), _ = drawn(figures)
    assert y_label == "team return per episode" and list(curve.get_ydata()) == [-1.5, -0.5]


def test_a_run_without_an_episode_has_no_curve(tmp_path):
    (tmp_path / "monitor.csv").write_text(HEADER)
    with pytest.raises(ValueError, match="No episode ended"):
        plot_learning_curve(tmp_path, tmp_path / "curve.png")


@pytest.mark.parametrize("cut", ["-2.0,5", "-2.0,5,0.3,Tr", "-2.0,5,0.3,", "-2.0,50,0.3,True", "-"])
def test_a_last_line_that_is_cut_off_is_left_out(cut, tmp_path):
    (tmp_path / "monitor.csv").write_text(HEADER + "-1.5,20,0.1,True\n-2.5,20,0.2,False\n" + cut)
    steps, returns, successes = read_monitor(tmp_path)
    assert (steps.tolist(), returns.tolist(), successes.tolist()) == ([20, 40], [-1.5, -2.5], [1, 0])
    for text in ("", HEADER[:20], HEADER[:-1]):
        (tmp_path / "monitor.csv").write_text(text)
        assert [len(array) for array in read_monitor(tmp_path)] == [0, 0, 0]


def test_another_damaged_line_is_named(tmp_path):
    (tmp_path / "monitor.csv").write_text(HEADER + "-1.5,20,0.1,True\n-2.5,2\n0.0,5,0.3,True\n")
    with pytest.raises(ValueError, match=r"monitor\.csv, line 4: '-2\.5,2' is not an episode"):
        read_monitor(tmp_path)


def test_runs_that_continue_others_share_one_axis(tmp_path, figures):
    first, second, third = (tmp_path / name for name in ("first", "second", "third"))
    for folder, start, trained in (
        (first, 0, None),
        (second, 20, first / "checkpoints" / "x.zip"),
        (third, 40, second / "team.zip"),
    ):
        folder.mkdir()
        (folder / "monitor.csv").write_text(HEADER + "".join(f"{start + 10 * i + 1}.0,10,0.1,True\n" for i in range(3)))
        record = {"start_timesteps": start, "trained_agent": None if trained is None else str(trained)}
        (folder / "run.json").write_text(json.dumps(record))
        write_evaluations(folder, [start + 10, start + 30], [[start], [start + 1]])
    steps, returns, _ = read_episodes(third)
    # A run that was continued from a checkpoint goes on itself; what it did then is another training
    assert steps.tolist() == [10, 20, 30, 40, 50, 60, 70] and returns.tolist() == [1, 11, 21, 31, 41, 51, 61]
    plot_learning_curve(third, tmp_path / "curve.png", quantity="return")
    lines = figures[-1].axes[0].get_lines()
    assert [line.get_xdata().tolist() for line in lines[1:]] == [[10], [30], [50, 70]]
    assert len(figures[-1].axes[0].get_legend().get_texts()) == 2
    for path in first.iterdir():
        path.unlink()
    # Without the first run the others keep their place
    assert read_episodes(third)[0].tolist() == [30, 40, 50, 60, 70]


@pytest.mark.parametrize(
    "record",
    [
        *("", "{", "[1]", "3", "null", '"x"', "{}", "[" * 100_000, '{"start_timesteps": 1e999, "trained_agent": "x"}'),
        *('{"start_timesteps": "x"}', '{"start_timesteps": [1]}', '{"start_timesteps": -5, "trained_agent": "x"}'),
        '{"start_timesteps": NaN, "trained_agent": "x"}',
        f'{{"start_timesteps": {10**400}, "trained_agent": "x"}}',
        '{"start_timesteps": 5, "trained_agent": [1]}',
    ],
)
def test_a_curve_needs_no_record(record, tmp_path):
    (tmp_path / "monitor.csv").write_text(HEADER + "-1.5,20,0.1,True\n")
    (tmp_path / "run.json").write_text(record)
    assert read_episodes(tmp_path)[0].tolist() == [20]
    assert plot_learning_curve(tmp_path, tmp_path / "curve.png").exists()


@pytest.mark.parametrize("trained", ["\x00", "a" * 300 + "/x", "nowhere/team.zip"])
def test_a_run_whose_beginning_is_lost_keeps_its_place(trained, tmp_path):
    (tmp_path / "monitor.csv").write_text(HEADER + "-1.5,20,0.1,True\n")
    (tmp_path / "run.json").write_text(json.dumps({"start_timesteps": 5, "trained_agent": trained}))
    assert read_episodes(tmp_path)[0].tolist() == [25]


def test_what_is_no_folder_of_a_run_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"No monitor\.csv in '.*nowhere': give the folder of a run"):
        plot_learning_curve(tmp_path / "nowhere", tmp_path / "curve.png")
    (tmp_path / "monitor.csv").write_bytes(HEADER.encode() + b"\xff,20,0.1,True\n-1.5,20,0.1,True\n")
    with pytest.raises(ValueError, match=r"monitor\.csv, line 3: .* is not an episode"):
        read_monitor(tmp_path)


def test_return_or_success_at_choice(tmp_path, figures):
    (tmp_path / "monitor.csv").write_text(HEADER + "-1.5,20,0.1,True\n-0.5,20,0.2,False\n")
    for quantity, label, values in (
        (None, "success rate", [1.0, 0.0]),
        ("success", "success rate", [1.0, 0.0]),
        ("return", "team return per episode", [-1.5, -0.5]),
    ):
        plot_learning_curve(tmp_path, tmp_path / "curve.png", quantity=quantity)
        _, y_label, (curve,), _ = drawn(figures)
        assert y_label == label and list(curve.get_ydata()) == values
    with pytest.raises(ValueError, match="quantity is 'reward'; it must be one of 'return', 'success'"):
        plot_learning_curve(tmp_path, tmp_path / "curve.png", quantity="reward")
    (tmp_path / "monitor.csv").write_text(HEADER + "-1.5,20,0.1,\n")
    with pytest.raises(ValueError, match="reports no successes"):
        plot_learning_curve(tmp_path, tmp_path / "curve.png", quantity="success")


def test_each_episode_counts_in_the_bin_in_which_it_ended():
    means = binned(np.array([5.0, 10.0, 11.0, 40.0]), np.array([1.0, 3.0, 7.0, 9.0]), np.array([0.0, 10.0, 20.0, 30.0, 40.0]))
    np.testing.assert_array_equal(means, [2.0, 7.0, np.nan, 9.0])
