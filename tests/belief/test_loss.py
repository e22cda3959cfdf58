"""What a prediction says of the others' actions (the losses themselves are in tests/equations)."""

import math

import pytest
import torch as th

from sb3_belief.belief import ActionLayout, cross_entropy, expected_actions, squared_error

LAYOUT = ActionLayout([[3], [2], [2, 3], [2]], ["categorical", "number", "categorical", "binary"])


def test_squared_error_by_hand():
    layout = ActionLayout([[2], [1]], ["categorical", "number"])
    prediction, actions = th.tensor([[0.5, 0.0, 3.0], [0.0, 0.0, 1.0]]), th.tensor([[1.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    visible = th.tensor([[True, True], [True, False]])
    # 0.25 and 4 of the first row, 1 of the second, of three who were seen
    assert squared_error(prediction, actions, visible, layout).item() == pytest.approx(5.25 / 3)


def test_cross_entropy_by_hand():
    layout = ActionLayout([[2, 2], [2]], ["categorical", "binary"])
    prediction = th.tensor([[math.log(3.0), 0.0, 0.0, 0.0, math.log(4.0), -math.log(4.0)]])
    actions = th.tensor([[1.0, 0.0, 0.0, 1.0, 1.0, 0.0]])
    expected = -math.log(3 / 4) - math.log(1 / 2) - 2 * math.log(4 / 5)
    assert cross_entropy(prediction, actions, th.tensor([[True, True]]), layout).item() == pytest.approx(expected / 2)
    of_second = cross_entropy(prediction, actions, th.tensor([[False, True]]), layout)
    assert of_second.item() == pytest.approx(-2 * math.log(4 / 5))


def test_cross_entropy_bears_large_logits():
    layout = ActionLayout([[2], [1]], ["categorical", "binary"])
    prediction = th.tensor([[1e4, -1e4, -1e4]], requires_grad=True)
    loss = cross_entropy(prediction, th.tensor([[0.0, 1.0, 1.0]]), th.tensor([[True, True]]), layout)
    loss.backward()
    assert loss.item() == pytest.approx(1.5e4) and prediction.grad is not None and prediction.grad.isfinite().all()


@pytest.mark.parametrize("action_loss", ["mse", "cross_entropy"])
def test_expected_actions_are_probabilities(action_loss):
    th.manual_seed(0)
    prediction = 3 * th.randn(50, LAYOUT.width)
    given = prediction.clone()
    expected = expected_actions(prediction, LAYOUT, action_loss)
    assert th.equal(prediction, given)
    for _, start, width in LAYOUT.blocks:
        part = expected[:, start : start + width]
        assert (part >= 0).all() and th.allclose(part.sum(dim=1), th.ones(50), atol=1e-6)
        given_part = prediction[:, start : start + width]
        says = given_part.max(dim=1).values > 0 if action_loss == "mse" else th.ones(50, dtype=th.bool)
        assert says.sum() > 20 and th.equal(part[says].argmax(dim=1), given_part[says].argmax(dim=1))
    assert th.equal(expected[:, 3:5], prediction[:, 3:5])  # numbers stay as they are
    binary = expected[:, LAYOUT.binary_columns]
    assert (binary >= 0).all() and (binary <= 1).all()


def test_expected_actions_of_the_squared_error_by_hand():
    prediction = th.tensor([[0.6, 0.2, -5.0, 7.0, -7.0, -1.0, -2.0, 0.0, 0.0, 3.0, 1.5, 0.25]])
    expected = expected_actions(prediction, LAYOUT, "mse")
    # An estimate with nothing above zero says nothing: uniform
    assert expected[0].tolist() == pytest.approx([0.75, 0.25, 0, 7, -7, 0.5, 0.5, 0, 0, 1, 1, 0.25])
