"""What an agent remembers."""

import torch as th

from sb3_belief.belief import append_rows, empty_history, filled_rows


def test_history_keeps_the_newest_rows_in_order():
    history = empty_history(5, 1, 1)
    assert not history.valid.any() and len(filled_rows(history).observations) == 0
    rows = th.arange(8.0).unsqueeze(1)
    first = append_rows(history, rows[:3], -rows[:3])
    assert first.valid.tolist() == [True, True, True, False, False]
    assert filled_rows(first).observations.flatten().tolist() == [0, 1, 2]
    second = append_rows(first, rows[3:], -rows[3:])
    assert second.observations.flatten().tolist() == [3, 4, 5, 6, 7] and second.valid.all()
    assert second.actions.flatten().tolist() == [-3, -4, -5, -6, -7]
    third = append_rows(first, rows[3:6], -rows[3:6])
    assert third.observations.flatten().tolist() == [1, 2, 3, 4, 5]
    assert filled_rows(first).observations.flatten().tolist() == [0, 1, 2]


def test_nothing_new_leaves_the_history_as_it_is():
    history = append_rows(empty_history(4, 2, 1), th.randn(3, 2), th.randn(3, 1))
    again = append_rows(history, th.zeros(0, 2), th.zeros(0, 1))
    assert all(th.equal(a, b) for a, b in zip(history, again, strict=True))


def test_a_history_may_be_filled_several_times_at_once():
    history = append_rows(empty_history(3, 1, 1), th.arange(10.0).unsqueeze(1), th.zeros(10, 1))
    assert history.observations.flatten().tolist() == [7, 8, 9] and history.valid.all()
    assert filled_rows(history) is history
