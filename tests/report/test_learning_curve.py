import numpy as np
import pytest

from sb3_belief.report.learning_curve import plot_learning_curve, read_evaluations, read_monitor, smooth

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
    assert read_evaluations(tmp_path) is None


def test_evaluations_are_averaged_over_their_episodes(tmp_path):
    np.savez(tmp_path / "evaluations.npz", timesteps=[10, 20], results=[[1.0, 3.0], [4.0, 4.0]], successes=[[True, False]] * 2)
    evaluations = read_evaluations(tmp_path)
    assert evaluations is not None
    steps, returns, successes = evaluations
    assert (steps.tolist(), returns.tolist(), successes.tolist()) == ([10, 20], [2.0, 4.0], [0.5, 0.5])


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
    np.savez(tmp_path / "evaluations.npz", timesteps=[1000, 2000], results=[[1.0], [2.0]], successes=[[False], [True]])
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
