import numpy as np
import pytest

from sb3_belief.report.comparison import binned, plot_comparison

HEADER = '#{"t_start": 0.0, "env_id": "Team"}\nr,l,t,is_success\n'


def write_run(folder, returns, success="True"):
    """A run whose episodes last ten joint steps."""
    folder.mkdir()
    rows = "".join(f"{r},10,{i},{success}\n" for i, r in enumerate(returns))
    (folder / "monitor.csv").write_text(HEADER + rows)
    return folder


def test_each_episode_counts_in_the_bin_in_which_it_ended():
    means = binned(np.array([5.0, 10.0, 11.0, 40.0]), np.array([1.0, 3.0, 7.0, 9.0]), np.array([0.0, 10.0, 20.0, 30.0, 40.0]))
    np.testing.assert_array_equal(means, [2.0, 7.0, np.nan, 9.0])


def test_lines_are_means_over_runs_and_bands_go_from_lowest_to_highest(tmp_path, monkeypatch):
    figure_module = pytest.importorskip("matplotlib.figure")
    saved = []
    monkeypatch.setattr(figure_module.Figure, "savefig", lambda self, path: saved.append(self))
    runs = {
        "dynamic": [write_run(tmp_path / "a", [0, 2, 4, 6]), write_run(tmp_path / "b", [2, 4, 6, 8])],
        "none": [write_run(tmp_path / "c", [1, 1, 1, 1])],
    }
    plot_comparison(runs, tmp_path / "curves.png", n_bins=2, title="Two games")
    (axes,) = saved[0].axes
    first, second = axes.get_lines()
    assert (first.get_label(), second.get_label()) == ("dynamic", "none")
    np.testing.assert_allclose(first.get_xydata(), [[10, 2], [30, 6]])
    np.testing.assert_allclose(second.get_xydata(), [[10, 1], [30, 1]])
    corners = axes.collections[0].get_paths()[0].vertices
    assert corners[:, 1].min() == 1 and corners[:, 1].max() == 7
    assert axes.get_ylabel() == "team return per episode" and axes.get_title(loc="left") == "Two games"


def test_successes_are_drawn_where_they_are_reported(tmp_path):
    pytest.importorskip("matplotlib")
    reported, silent = write_run(tmp_path / "reported", [0, 0]), write_run(tmp_path / "silent", [0, 0], success="")
    assert plot_comparison({"a": [reported]}, tmp_path / "sub" / "a.png", "success").is_file()
    with pytest.raises(ValueError, match=r"silent.*reports no successes; draw quantity='return'"):
        plot_comparison({"a": [silent]}, tmp_path / "b.png", "success")
    with pytest.raises(ValueError, match="quantity is 'wins'; it must be one of 'return', 'success'"):
        plot_comparison({"a": [reported]}, tmp_path / "b.png", "wins")


def test_a_run_without_an_episode_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"No episode ended in .*empty"):
        plot_comparison({"a": [write_run(tmp_path / "empty", [])]}, tmp_path / "b.png")
