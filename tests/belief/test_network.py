"""The belief network's parts; its numbers are compared with the equations in tests/equations."""

import pytest
import torch as th

from sb3_belief.belief import VARIANTS, DynamicBelief, History, empty_history, n_selected

D_O, W, D, Z = 6, 5, 8, 4


def random_history(length: int = 40) -> History:
    return History(th.randn(length, D_O), th.randn(length, W), th.ones(length, dtype=th.bool))


def test_rows_can_be_selected_beforehand():
    net = DynamicBelief(D_O, W, D, Z, 0.1)
    history = random_history()
    observations = th.randn(5, D_O)
    free = net(observations, history)
    again = net(observations, history, selected=free.selected, context=net.encode_history(history))
    th.testing.assert_close(again.latent, free.latent)
    other = net(observations, history, selected=(free.selected + 1) % 40)
    assert (other.latent - free.latent).abs().max() > 1e-3


def test_more_rows_than_there_are_cannot_be_kept():
    net = DynamicBelief(D_O, W, D, Z)
    with pytest.raises(ValueError, match="3 rows are selected from a history of 2"):
        net(th.randn(1, D_O), random_history(2), selected=th.zeros(1, 3, dtype=th.long))


@pytest.mark.parametrize("kept", [None, th.zeros(3, 0, dtype=th.int)])
def test_while_the_history_is_empty_the_attention_is_not_trained(kept):
    net = DynamicBelief(D_O, W, D, Z)
    net(th.randn(3, D_O), empty_history(9, D_O, W), selected=kept).prediction.sum().backward()
    without = {name.split(".")[0] for name, parameter in net.named_parameters() if parameter.grad is None}
    assert without == {"action_embedding", "query", "key", "value"}


@pytest.mark.parametrize("keep_ratio", [0.01, 0.05, 0.5, 1.0])
def test_at_least_one_row_is_kept_and_at_most_all(keep_ratio):
    for n_rows in range(1, 50):
        assert 1 <= n_selected(keep_ratio, n_rows) <= n_rows
    assert n_selected(keep_ratio, 0) == 0 and n_selected(keep_ratio, 1000) == 1000 * keep_ratio


PARTS = {
    "dynamic": {"observation_embedding", "action_embedding", "query", "key", "value", "encoder", "decoder"},
    "context": {"observation_embedding", "action_embedding", "query", "key", "value", "encoder", "decoder"},
    "variational": {"observation_embedding", "encoder", "decoder"},
    "static": {"observation_embedding", "encoder", "decoder"},
    "wide": {"observation_embedding", "encoder"},
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_what_a_variant_does_not_use_is_not_built(variant):
    net = DynamicBelief(D_O, W, D, Z, variant=variant)
    assert {name for name, _ in net.named_children()} == PARTS[variant]
    widths = {"dynamic": 2 * Z, "variational": 2 * Z, "context": Z, "static": Z}
    if variant in widths:
        assert dict(net.named_parameters())["encoder.weight"].shape == (widths[variant], D)
    # and all that is built is used
    output = net(th.randn(7, D_O), random_history(), th.randn(7, Z))
    (output.latent.square().sum() + (0 if output.prediction is None else output.prediction.square().sum())).backward()
    assert all(parameter.grad is not None and parameter.grad.any() for parameter in net.parameters())


@pytest.mark.parametrize("variant", VARIANTS)
def test_what_a_variant_does_not_have_does_not_matter(variant):
    net = DynamicBelief(D_O, W, D, Z, variant=variant)
    attends, samples, *_ = VARIANTS[variant]
    observations = th.randn(7, D_O)
    history, noise = random_history(), th.randn(7, Z)
    plain = net(observations, history).latent
    assert th.equal(net(observations, history, noise).latent, plain) != samples
    assert th.equal(net(observations, random_history()).latent, plain) != attends
    if attends:
        with pytest.raises(ValueError, match="empty_history"):
            net(observations)
        assert net(observations, empty_history(9, D_O, W)).selected.shape == (7, 0)
    else:
        assert th.equal(net(observations).latent, plain)


@pytest.mark.parametrize("similarity", ["embedding", "observation"])
def test_no_gradient_flows_through_the_choice_of_rows(similarity):
    net = DynamicBelief(D_O, W, D, Z, 0.1, similarity=similarity)
    observations, history = th.randn(5, D_O), random_history()
    kept = net(observations, history).selected
    gradients = []
    for given in (None, kept):
        net.zero_grad()
        net(observations, history, selected=given).latent.sum().backward()
        gradients.append([parameter.grad.clone() for parameter in net.parameters() if parameter.grad is not None])
    for a, b in zip(*gradients, strict=True):
        th.testing.assert_close(a, b)
    directions = net.encode_history(history).directions
    assert not directions.requires_grad


@pytest.mark.parametrize("widths", [(64, 64), (16, 8), (8, 32), (1, 1)])
@pytest.mark.parametrize("action_dim", [1, 5, 60])
def test_wide_has_as_many_weights_as_dynamic(action_dim, widths):
    embedding_dim, latent_dim = widths
    dynamic, wide = (
        sum(p.numel() for p in DynamicBelief(D_O, action_dim, embedding_dim, latent_dim, variant=variant).parameters())
        for variant in ("dynamic", "wide")
    )
    of_a_hidden_unit = embedding_dim + 1 + latent_dim
    assert abs(dynamic - wide) <= of_a_hidden_unit / 2
