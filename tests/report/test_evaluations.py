"""What the file of a run's evaluations holds."""

import numpy as np
import pytest

from sb3_belief.report.evaluations import read_evaluations
from tests.study.folders import write_evaluations


def test_evaluations_are_read_with_their_means(tmp_path):
    assert read_evaluations(tmp_path) is None
    write_evaluations(
        tmp_path, [10, 20, 30], [[1.0, 3.0], [4.0, 4.0], [4.0, 4.0]], [[True, False], [False, False], [True, True]]
    )
    found = read_evaluations(tmp_path)
    assert found is not None and found.steps.tolist() == [10, 20, 30]
    assert found.mean_returns.tolist() == [2.0, 4.0, 4.0] and found.success_rates.tolist() == [0.5, 0.0, 1.0]
    # Of equal ones the first, as SB3 keeps it
    assert found.best == 1
    assert found.rows()[1] == {
        **{"phase": "training", "checkpoint": "current", "deterministic": True, "joint_steps": 10},
        **{"episode": 1, "episode_return": 3.0, "success": 0.0, "length": 5},
    }


def test_successes_may_come_later_or_never(tmp_path):
    write_evaluations(tmp_path, [10, 20], [[1.0, 3.0], [4.0, 4.0]])
    found = read_evaluations(tmp_path)
    assert found is not None and found.successes is None and np.isnan(found.success_rates).all()
    assert {row["success"] for row in found.rows()} == {None}
    write_evaluations(tmp_path, [10, 20], [[1.0, 3.0], [4.0, 4.0]], [[True, False]])
    found = read_evaluations(tmp_path)
    assert found is not None and [row["success"] for row in found.rows()] == [None, None, 1.0, 0.0]
    # Which episodes these were is not known
    write_evaluations(tmp_path, [10], [[1.0, 3.0]], [[True]])
    found = read_evaluations(tmp_path)
    assert found is not None and [row["success"] for row in found.rows()] == [None, None]


@pytest.mark.parametrize("content", [b"", b"PK cut", b"PK\x03\x04", b"\x93NUMPY"])
def test_a_damaged_file_is_named(content, tmp_path):
    (tmp_path / "evaluations.npz").write_bytes(content)
    with pytest.raises(ValueError, match=r"evaluations\.npz is damaged \(.+\)"):
        read_evaluations(tmp_path)


@pytest.mark.parametrize(
    "changes", [{"timesteps": [1, 2]}, {"results": [1.0, 2.0]}, {"ep_lengths": [[1, 2, 3]]}, {"results": [["a", "b"]]}]
)
def test_parts_that_do_not_fit_are_damage(changes, tmp_path):
    parts = {"timesteps": [1], "results": [[1.0, 2.0]], "ep_lengths": [[1, 2]]}
    np.savez(tmp_path / "evaluations.npz", **{**parts, **changes})
    with pytest.raises(ValueError, match="is damaged"):
        read_evaluations(tmp_path)
    np.save(tmp_path / "one.npy", np.zeros(3))
    (tmp_path / "one.npy").replace(tmp_path / "evaluations.npz")
    with pytest.raises(ValueError, match="is damaged"):
        read_evaluations(tmp_path)


def test_an_empty_file_has_no_evaluation(tmp_path):
    write_evaluations(tmp_path, [], np.zeros((0, 4)))
    assert read_evaluations(tmp_path) is None
