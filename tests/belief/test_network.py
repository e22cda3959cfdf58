"""The network against an independent computation, written from the paper in numpy (eq. 3 to 7)."""

import numpy as np
import pytest
import torch as th

from sb3_belief.belief import ActionLayout, DynamicBelief, History, append_rows, empty_history, kl_divergence, squared_error

D_O, W, D, Z = 6, 5, 8, 4


def weights_of(net: DynamicBelief) -> dict[str, np.ndarray]:
    return {name: value.detach().numpy().astype(np.float64) for name, value in net.named_parameters()}


def linear(p: dict[str, np.ndarray], name: str, x: np.ndarray) -> np.ndarray:
    return x @ p[f"{name}.weight"].T + p.get(f"{name}.bias", np.zeros(1))


def reference_belief(net, observation, history_observations, history_actions, noise, n_kept):
    """One observation's belief, in double precision and plain loops."""
    p = weights_of(net)

    def embed(o):
        return linear(p, "observation_embedding.2", np.maximum(linear(p, "observation_embedding.0", o), 0))

    e = embed(observation)
    context = e.copy()
    kept = []
    if len(history_observations):
        embedded = [embed(o) for o in history_observations]
        cosine = [e @ h / (np.linalg.norm(e) * np.linalg.norm(h)) for h in embedded]
        kept = sorted(np.argsort(cosine)[::-1][:n_kept])
        states = [embedded[i] + linear(p, "action_embedding", history_actions[i]) for i in kept]
        scores = np.array([linear(p, "query", e) @ linear(p, "key", s) for s in states]) / np.sqrt(D)
        attention = np.exp(scores - scores.max())
        attention /= attention.sum()
        for weight, state in zip(attention, states, strict=True):
            context += weight * linear(p, "value", state)
    mean, log_std = np.split(linear(p, "encoder", context), 2)
    log_std = np.clip(log_std, -5, 2)
    latent = mean if noise is None else mean + np.exp(log_std) * noise
    return latent, mean, log_std, linear(p, "decoder", latent), kept


@pytest.mark.parametrize("n_filled", [0, 1, 7, 60])
@pytest.mark.parametrize("keep_ratio", [0.05, 0.5, 1.0])
@pytest.mark.parametrize("with_noise", [False, True])
def test_equals_the_equations(n_filled, keep_ratio, with_noise):
    th.manual_seed(n_filled)
    net = DynamicBelief(D_O, W, D, Z, keep_ratio)
    history = append_rows(empty_history(60, D_O, W), th.randn(n_filled, D_O), th.randn(n_filled, W))
    observations = th.randn(9, D_O)
    noise = th.randn(9, Z) if with_noise else None
    output = net(observations, history, noise)
    n_kept = min(n_filled, max(1, round(keep_ratio * n_filled)))
    assert output.kept.shape == (9, n_kept)
    for row in range(9):
        latent, mean, log_std, prediction, kept = reference_belief(
            net,
            observations[row].numpy(),
            history.observations[:n_filled].numpy(),
            history.actions[:n_filled].numpy(),
            None if noise is None else noise[row].numpy(),
            n_kept,
        )
        assert sorted(output.kept[row].tolist()) == kept
        for name, expected in dict(latent=latent, mean=mean, log_std=log_std, prediction=prediction).items():
            np.testing.assert_allclose(getattr(output, name)[row].detach().numpy(), expected, atol=1e-5)
    if n_kept:
        np.testing.assert_allclose(output.weights.detach().sum(dim=1).numpy(), 1, atol=1e-6)


def test_rows_can_be_selected_beforehand():
    net = DynamicBelief(D_O, W, D, Z, 0.1)
    history = History(th.randn(40, D_O), th.randn(40, W), th.ones(40, dtype=th.bool))
    observations = th.randn(5, D_O)
    free = net(observations, history)
    again = net(observations, history, kept=free.kept, context=net.encode_history(history))
    th.testing.assert_close(again.latent, free.latent)
    other = net(observations, history, kept=(free.kept + 1) % 40)
    assert (other.latent - free.latent).abs().max() > 1e-3


def test_losses_equal_the_equations():
    th.manual_seed(0)
    layout = ActionLayout([[3], [2]], ["categorical", "number"])
    assert layout.owners == [0, 0, 0, 1, 1] and layout.blocks == [(0, 0, 3)]
    prediction, actions = th.randn(6, 5), th.randn(6, 5)
    visible = th.rand(6, 2) < 0.5
    expected, count = 0.0, 0
    for b in range(6):
        for other, columns in enumerate([[0, 1, 2], [3, 4]]):
            if visible[b, other]:
                expected += sum(float(actions[b, c] - prediction[b, c]) ** 2 for c in columns)
                count += 1
    result = squared_error(prediction, actions, visible, layout)
    assert count > 2 and result.item() == pytest.approx(expected / count, rel=1e-5)
    nobody = th.zeros(6, 2, dtype=th.bool)
    assert squared_error(prediction, actions, nobody, layout).item() == 0

    mean, log_std = th.randn(6, Z), 0.3 * th.randn(6, Z)
    normal = th.distributions.Normal
    expected_kl = th.distributions.kl_divergence(normal(mean, log_std.exp()), normal(th.zeros(6, Z), th.ones(6, Z)))
    assert kl_divergence(mean, log_std).item() == pytest.approx(expected_kl.sum(1).mean().item(), rel=1e-5)


def test_gradient_of_the_loss_reaches_every_module():
    net = DynamicBelief(D_O, W, D, Z)
    history = History(th.randn(100, D_O), th.randn(100, W), th.ones(100, dtype=th.bool))
    output = net(th.randn(8, D_O), history, th.randn(8, Z))
    visible = th.ones(8, 1, dtype=th.bool)
    loss = squared_error(output.prediction, th.randn(8, W), visible, ActionLayout([[W]], ["number"]))
    (loss + kl_divergence(output.mean, output.log_std)).backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().max() > 0, name


def test_history_keeps_the_newest_rows_in_order():
    history = empty_history(5, 1, 1)
    assert not history.valid.any() and len(history.filled().observations) == 0
    rows = th.arange(8.0).unsqueeze(1)
    first = append_rows(history, rows[:3], -rows[:3])
    assert first.valid.tolist() == [True, True, True, False, False]
    assert first.filled().observations.flatten().tolist() == [0, 1, 2]
    second = append_rows(first, rows[3:], -rows[3:])
    assert second.observations.flatten().tolist() == [3, 4, 5, 6, 7] and second.valid.all()
    assert second.actions.flatten().tolist() == [-3, -4, -5, -6, -7]
    third = append_rows(first, rows[3:6], -rows[3:6])
    assert third.observations.flatten().tolist() == [1, 2, 3, 4, 5]
    assert first.filled().observations.flatten().tolist() == [0, 1, 2]


def test_layout_refuses_what_does_not_fit():
    with pytest.raises(ValueError, match="2 others"):
        ActionLayout([[3], [2]], ["categorical"])
    with pytest.raises(ValueError, match="categorical, binary, number"):
        ActionLayout([[3]], ["discrete"])
