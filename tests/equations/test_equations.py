"""The network and its loss against an independent computation, written from the paper in numpy (eq. 3 to 8)."""

from typing import Any, NamedTuple

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_belief.belief import VARIANTS, DynamicBelief, History, append_rows, empty_history, filled_rows, kl_divergence
from sb3_belief.belief_ppo import BeliefActorCriticPolicy, BeliefMinibatch
from sb3_belief.belief_ppo.buffers import attach, read_others
from sb3_belief.belief_ppo.extractor import BeliefPass
from tests.equations import reference
from tests.equations.reference import Belief, Other, Weights

D_O, W, D, Z, LENGTH = 6, 5, 8, 4, 60
CLOSE: dict[str, Any] = dict(atol=1e-5, rtol=0)


def weights_of(module: th.nn.Module) -> Weights:
    return {name: value.detach().numpy().astype(np.float64) for name, value in module.named_parameters()}


def filled_history(n_filled: int, width: int = W) -> History:
    actions = th.eye(width)[th.randint(width, (n_filled,))]
    return append_rows(empty_history(LENGTH, D_O, width), th.randn(n_filled, D_O), actions)


def check_selection(weights: Weights, similarity: str, keep_ratio: float, observation, rows, kept: list[int]) -> None:
    """Which rows of equal similarity are kept is open; that no row left out is more similar than one kept is not."""
    scores = reference.similarities(weights, similarity, observation, rows)
    expected = reference.most_similar(scores, keep_ratio)
    assert len(set(kept)) == len(kept) == len(expected)
    np.testing.assert_allclose(sorted(scores[row] for row in kept), sorted(scores[row] for row in expected), atol=1e-6)


def expected_beliefs(weights, variant, similarity, keep_ratio, observations, history, noise, kept) -> list[Belief]:
    """The beliefs of a batch, each given the rows that the network kept, which are checked as well."""
    rows, actions = (part.numpy().astype(np.float64) for part in filled_rows(history)[:2])
    result = []
    for b, observation in enumerate(observations.numpy().astype(np.float64)):
        chosen = kept[b].tolist()
        if variant in reference.ATTENDING:
            check_selection(weights, similarity, keep_ratio, observation, rows, chosen)
        else:
            assert chosen == []
        drawn = None if noise is None else noise[b].numpy().astype(np.float64)
        result.append(reference.belief(weights, variant, observation, rows, actions, drawn, chosen))
    return result


def assert_equal(output, beliefs: list[Belief]) -> None:
    for b, expected in enumerate(beliefs):
        for name in ("latent", "mean", "log_std", "prediction"):
            found, value = getattr(output, name), getattr(expected, name)
            if value is None:
                assert found is None or th.isinf(found).all()
            else:
                np.testing.assert_allclose(found[b].detach().numpy(), value, **CLOSE)
        np.testing.assert_allclose(output.weights[b].detach().numpy(), expected.attention, **CLOSE)


@pytest.mark.parametrize("n_filled", [0, 1, 7, LENGTH])
@pytest.mark.parametrize("keep_ratio", [0.05, 0.5, 1.0])
@pytest.mark.parametrize("similarity", ["embedding", "observation"])
@pytest.mark.parametrize("variant", VARIANTS)
def test_belief_equals_the_equations(variant, similarity, keep_ratio, n_filled):
    th.manual_seed(n_filled)
    net = DynamicBelief(D_O, W, D, Z, keep_ratio, variant, similarity)
    history, observations = filled_history(n_filled), th.randn(5, D_O)
    for noise in (None, th.randn(5, Z)):
        output = net(observations, history, noise)
        assert_equal(
            output,
            expected_beliefs(weights_of(net), variant, similarity, keep_ratio, observations, history, noise, output.selected),
        )


@pytest.mark.parametrize("similarity", ["embedding", "observation"])
def test_any_choice_among_equally_similar_rows_is_right(similarity):
    th.manual_seed(0)
    net = DynamicBelief(D_O, W, D, Z, 0.3, "dynamic", similarity)
    rows = th.randn(3, D_O)
    # The same three observations over and over, with different actions, and one that has no direction at all
    observations = th.cat([rows.repeat(6, 1), 2 * rows, th.zeros(2, D_O)])
    history = append_rows(empty_history(LENGTH, D_O, W), observations, th.randn(23, W))
    asked = th.cat([rows, th.zeros(1, D_O), th.randn(2, D_O)])
    noise = th.randn(6, Z)
    output = net(asked, history, noise)
    assert output.selected.shape == (6, 7)
    assert_equal(output, expected_beliefs(weights_of(net), "dynamic", similarity, 0.3, asked, history, noise, output.selected))
    if similarity == "observation":  # a cosine knows no length: row and double row alike, in whatever order
        assert all(set(output.selected[i].tolist()) == {i + 3 * k for k in range(7)} for i in range(3))


def test_a_log_deviation_out_of_range_is_clamped():
    th.manual_seed(0)
    net = DynamicBelief(D_O, W, D, Z, 0.5)
    with th.no_grad():
        dict(net.named_parameters())["encoder.bias"][Z:] = th.tensor([-40.0, 40.0, 0.0, 1.0])
    history, observations, noise = filled_history(9), th.randn(5, D_O), th.randn(5, Z)
    output = net(observations, history, noise)
    assert output.log_std[:, 0].unique().tolist() == [-5] and output.log_std[:, 1].unique().tolist() == [2]
    assert_equal(
        output, expected_beliefs(weights_of(net), "dynamic", "embedding", 0.5, observations, history, noise, output.selected)
    )


def least_similar(scores: list[float], keep_ratio: float) -> list[int]:
    """Eq. 3 as it is printed."""
    return MOST_SIMILAR([-score for score in scores], keep_ratio)


MOST_SIMILAR, EMBEDDING = reference.most_similar, reference.observation_embedding


@pytest.mark.parametrize(
    "part, reading",
    [
        ("most_similar", least_similar),
        ("scale", lambda width: 1.0),
        ("observation_embedding", lambda weights, observation: 0.99 * EMBEDDING(weights, observation)),
        ("deviation", lambda log_std: np.exp(log_std / 2)),  # sigma called a variance
    ],
)
def test_the_comparison_notices_another_reading(part, reading, monkeypatch):
    th.manual_seed(0)
    net = DynamicBelief(D_O, W, D, Z, 0.2)
    history, observations, noise = filled_history(40), th.randn(5, D_O), th.randn(5, Z)
    output, weights = net(observations, history, noise), weights_of(net)
    monkeypatch.setattr(reference, part, reading)
    with pytest.raises(AssertionError):
        assert_equal(
            output, expected_beliefs(weights, "dynamic", "embedding", 0.2, observations, history, noise, output.selected)
        )


# -- the loss, through the policy --------------------------------------------------------------------------------------

ONE = {"b": spaces.Discrete(4)}
MANY: dict[str, spaces.Space] = {
    "b": spaces.Discrete(3),
    "c": spaces.MultiBinary(3),
    "d": spaces.MultiDiscrete([2, 4]),
    "e": spaces.Discrete(3),
    "f": spaces.Box(-1, 1, (2,), np.float32),
    "g": spaces.MultiDiscrete([3, 2, 2]),
    "h": spaces.MultiBinary(2),
}
CHOOSING = {name: space for name, space in MANY.items() if not isinstance(space, spaces.Box)}


def test_actions_are_flattened_as_the_environment_does():
    for space in MANY.values():
        space.seed(0)
        action = space.sample()
        np.testing.assert_array_equal(reference.flat_action(described(space), action), spaces.flatten(space, action))


def described(space: spaces.Space) -> Other:
    if isinstance(space, spaces.Discrete):
        return Other("discrete", (int(space.n),))
    if isinstance(space, spaces.MultiDiscrete):
        return Other("multi_discrete", tuple(int(n) for n in space.nvec))
    assert space.shape is not None
    return Other("multi_binary" if isinstance(space, spaces.MultiBinary) else "box", space.shape)


class Case(NamedTuple):
    """A policy among others, with its history and a minibatch of five rows."""

    policy: BeliefActorCriticPolicy
    others: list[Other]
    observations: th.Tensor
    minibatch: BeliefMinibatch
    actions: list[list[np.ndarray]]

    def run(self) -> th.Tensor | None:
        """The belief's loss as the update computes it."""
        belief_pass = BeliefPass(self.minibatch.noise, self.minibatch.selected)
        self.policy.extract_features(attach(self.observations, belief_pass))
        assert belief_pass.output is not None
        return self.policy.belief_loss(belief_pass.output, self.minibatch)


def make_case(variant: str, spaces_of: dict[str, spaces.Space], n_filled: int, **kwargs: Any) -> Case:
    th.manual_seed(n_filled)
    rng = np.random.default_rng(n_filled)
    others = [described(space) for space in spaces_of.values()]
    policy = BeliefActorCriticPolicy(
        spaces.Box(-1, 1, (D_O,), np.float32),
        spaces.Discrete(3),
        lambda _: 1e-3,
        others_action_spaces=spaces_of,
        belief=variant,
        history_length=LENGTH,
        keep_ratio=0.2,
        embedding_dim=D,
        latent_dim=Z,
        **kwargs,
    )

    def joint_actions(n: int) -> tuple[list[list[np.ndarray]], np.ndarray]:
        for index, space in enumerate(spaces_of.values()):
            space.seed(int(rng.integers(1000)) + index)
        drawn = [[np.asarray(space.sample()) for space in spaces_of.values()] for _ in range(n)]
        flat = [[x for o, a in zip(others, row, strict=True) for x in reference.flat_action(o, a)] for row in drawn]
        return drawn, np.array(flat, dtype=np.float32).reshape(n, sum(other.width for other in others))

    policy.remember(th.randn(n_filled, D_O).numpy(), joint_actions(n_filled)[1])
    observations = th.randn(5, D_O)
    actions, flat = joint_actions(5)
    visible = rng.random((5, len(others))) < 0.6
    infos = [{"others_actions": row, "others_visible": seen} for row, seen in zip(flat, visible, strict=True)]
    others_actions, others_visible = (th.as_tensor(part) for part in read_others(infos, policy.layout))
    with th.no_grad():
        kept = policy.belief(observations, policy.history).selected  # type: ignore[misc]
    noise = th.randn(5, Z if variant in reference.SAMPLING else 0)
    return Case(policy, others, observations, BeliefMinibatch(noise, kept, others_actions, others_visible), actions)


def expected_loss(case: Case, weights: Weights, variant: str, alpha: float, beta: float, loss: str) -> float:
    history = case.policy.history
    rows, actions = (
        (np.zeros((0, D_O)), np.zeros((0, 1)))
        if history is None
        else (part.numpy().astype(np.float64) for part in filled_rows(history)[:2])
    )
    part = case.minibatch
    beliefs = [
        reference.belief(weights, variant, observation.numpy(), rows, actions, noise.numpy(), kept.tolist())
        for observation, noise, kept in zip(case.observations, part.noise, part.selected, strict=True)
    ]
    visible = part.others_visible.numpy()
    return reference.belief_loss(beliefs, variant, alpha, beta, loss, case.actions, visible, case.others)


@pytest.mark.parametrize("n_filled", [0, 11, LENGTH])
@pytest.mark.parametrize("loss, spaces_of", [("mse", ONE), ("mse", MANY), ("cross_entropy", ONE), ("cross_entropy", CHOOSING)])
@pytest.mark.parametrize("variant", VARIANTS)
def test_loss_equals_the_equations(variant, loss, spaces_of, n_filled):
    case = make_case(variant, spaces_of, n_filled, action_loss=loss)
    weights = weights_of(case.policy.belief)  # type: ignore[arg-type]
    for alpha, beta in ((0.5, 0.005), (2.0, 0.0), (0.0, 0.3)):
        case.policy.action_coef, case.policy.kl_coef = alpha, beta
        found, expected = case.run(), expected_loss(case, weights, variant, alpha, beta, loss)
        if variant == "wide":
            assert found is None and expected == 0
        else:
            assert found is not None and found.item() == pytest.approx(expected, abs=1e-5, rel=1e-5)


@pytest.mark.parametrize("loss", ["mse", "cross_entropy"])
def test_loss_is_zero_where_nobody_is_visible(loss):
    case = make_case("static", CHOOSING, 0, action_loss=loss)
    nobody = case.minibatch._replace(others_visible=th.zeros_like(case.minibatch.others_visible))
    found = case._replace(minibatch=nobody).run()
    assert found is not None and found.item() == 0
    found.backward()
    assert not any(p.grad.any() for p in case.policy.belief.parameters() if p.grad is not None)  # type: ignore[union-attr]


def test_divergence_equals_that_of_the_distributions():
    th.manual_seed(0)
    mean, log_std, normal = th.randn(6, Z), 0.3 * th.randn(6, Z), th.distributions.Normal
    expected = th.distributions.kl_divergence(normal(mean, log_std.exp()), normal(th.zeros(6, Z), th.ones(6, Z)))
    assert kl_divergence(mean, log_std).item() == pytest.approx(expected.sum(1).mean().item(), rel=1e-5)
    assert reference.kl(mean.numpy(), log_std.numpy()) == pytest.approx(expected.sum(1).mean().item(), rel=1e-5)


# -- its gradient ------------------------------------------------------------------------------------------------------

MODULES = {
    "dynamic": {"observation_embedding", "action_embedding", "query", "key", "value", "encoder", "decoder"},
    "context": {"observation_embedding", "action_embedding", "query", "key", "value", "encoder", "decoder"},
    "variational": {"observation_embedding", "encoder", "decoder"},
    "static": {"observation_embedding", "encoder", "decoder"},
}


@pytest.mark.parametrize("loss", ["mse", "cross_entropy"])
@pytest.mark.parametrize("variant", MODULES)
def test_gradient_of_the_loss_reaches_every_module(variant, loss):
    case = make_case(variant, CHOOSING, LENGTH, action_loss=loss)
    found = case.run()
    assert found is not None
    found.backward()
    belief = case.policy.belief
    assert belief is not None
    assert {name for name, _ in belief.named_children()} == MODULES[variant]
    for name, parameter in belief.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().max() > 0, name
    outside = [p for name, p in case.policy.named_parameters() if ".belief." not in name]
    assert outside and all(parameter.grad is None for parameter in outside)


@pytest.mark.parametrize("loss", ["mse", "cross_entropy"])
@pytest.mark.parametrize("variant", MODULES)
def test_gradient_equals_the_slope_of_the_equations(variant, loss):
    """Backpropagation against finite differences of the numpy computation, at three weights of every layer."""
    case = make_case(variant, CHOOSING, 11, action_loss=loss)
    case.policy.kl_coef = 0.05
    found = case.run()
    assert found is not None
    found.backward()
    belief, rng, step = case.policy.belief, np.random.default_rng(0), 1e-5
    assert belief is not None
    weights = weights_of(belief)
    for name, parameter in belief.named_parameters():
        for _ in range(3):
            place = tuple(int(rng.integers(n)) for n in parameter.shape)
            at, slope = weights[name][place], 0.0
            for sign in (1, -1):
                weights[name][place] = at + sign * step
                slope += sign * expected_loss(case, weights, variant, 0.5, 0.05, loss) / (2 * step)
            weights[name][place] = at
            assert parameter.grad is not None
            assert parameter.grad[place].item() == pytest.approx(slope, abs=1e-6, rel=1e-3), (name, place)
