"""The network of the adaptive belief against a computation of its own, and what it may attend to."""

from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_belief.belief import ROW_FEATURES, AdaptiveBelief
from sb3_belief.belief.memory import DEPLOYED, Memory, empty_memory, followed_by, newest

D_O, W, OWN = 3, 4, 3


def network(n_own: Any = 3, n_pool: Any = 2, **kwargs: Any) -> AdaptiveBelief:
    th.manual_seed(0)
    belief = AdaptiveBelief(D_O, W, OWN, embedding_dim=6, latent_dim=5, n_own=n_own, n_pool=n_pool, **kwargs)
    with th.no_grad():
        # The null row starts as zeros
        belief.null_key.normal_()
        belief.null_value.normal_()
    return belief


def memory_of(n_rows: int, n_copies: int = 3, episode: int = 4) -> Memory:
    """Rows of some copies in turn, in episodes of a few steps, of which every fifth is not valid."""
    generator = th.Generator().manual_seed(1)
    numbers = th.arange(n_rows)
    times, copies = numbers // n_copies, numbers % n_copies
    seen, did, own = (th.randn(n_rows, width, generator=generator) for width in (D_O, W, OWN))
    return Memory(seen, did, own, th.stack([times, copies, times // episode * episode], dim=1), numbers % 5 != 4)


def stamps_of(*rows: tuple[int, int, int]) -> th.Tensor:
    return th.tensor(rows, dtype=th.int64)


def relu(x: np.ndarray) -> np.ndarray:
    return np.maximum(x, 0)


def reference(belief: AdaptiveBelief, observation: np.ndarray, stamp: tuple[int, ...], memory: Memory) -> dict[str, Any]:
    """Compute the belief at one observation row by row, in numpy and double precision."""
    weights = {name: value.double().numpy() for name, value in belief.state_dict().items()}

    def linear(name: str, x: np.ndarray) -> np.ndarray:
        return weights[f"{name}.weight"] @ x + weights.get(f"{name}.bias", 0.0)

    def embedded(x: np.ndarray) -> np.ndarray:
        return linear("observation_embedding.2", relu(linear("observation_embedding.0", x)))

    embedding = embedded(observation)
    query, root = linear("query", embedding), np.sqrt(6)
    rows = []
    for number in range(len(memory.valid)):
        seen, did, own, at, valid = (part[number].numpy() for part in memory)
        if not valid:
            continue
        row = embedded(seen.astype(float)) + linear("event_embedding", np.concatenate([did, own]).astype(float))
        same_copy = float(at[1] == stamp[1])
        same_episode = float(same_copy and at[2] == stamp[2])
        pair = np.array([np.log1p(max(0, stamp[0] - at[0])) / np.log(1000), same_episode, same_copy])
        score = query @ linear("key", row) / root + (weights["pair_score.weight"] @ pair)[0]
        rows.append((number, score, bool(same_copy), linear("value", row) + linear("pair_value", pair)))
    chosen = []
    for scope, n in ((True, belief.n_own), (False, belief.n_pool)):
        chosen += sorted((each for each in rows if each[2] == scope), key=lambda each: -each[1])[:n]
    scores = np.array([score for _, score, _, _ in chosen] + [query @ weights["null_key"] / root])
    attention = np.exp(scores - scores.max())
    attention /= attention.sum()
    values = [value for *_, value in chosen] + [weights["null_value"]]
    context = embedding + sum(w * value for w, value in zip(attention, values, strict=True))
    mean = linear("encoder.1", relu(context))
    return {
        "rows": {number: w for (number, *_), w in zip(chosen, attention, strict=False)},
        "null": attention[-1],
        "mean": mean,
        "prediction": linear("decoder", mean),
    }


@pytest.mark.parametrize("n_rows", [0, 1, 2, 7, 40])
@pytest.mark.parametrize("scopes", [(3, 2), (3, 0), (0, 4)])
def test_latent_prediction_and_attention_equal_an_independent_computation(n_rows, scopes):
    belief, memory = network(*scopes), memory_of(n_rows)
    observations = th.randn(4, D_O, generator=th.Generator().manual_seed(2))
    stamps = [(n_rows // 3 + 1, copy, 4 * (n_rows // 12)) for copy in (0, 1, 2, DEPLOYED)]
    output = belief(observations, stamps_of(*stamps), belief.encode(memory))
    for i, stamp in enumerate(stamps):
        expected = reference(belief, observations[i].double().numpy(), stamp, memory)
        rows = list(zip(output.selected[i].tolist(), output.weights[i].tolist(), strict=True))
        attended = {row: weight for row, weight in rows if row >= 0}
        assert attended == pytest.approx(expected["rows"], abs=1e-5)
        assert float(output.weights[i, -1].detach()) == pytest.approx(expected["null"], abs=1e-5)
        np.testing.assert_allclose(output.mean[i].detach(), expected["mean"], atol=1e-5)
        assert output.prediction is not None
        np.testing.assert_allclose(output.prediction[i].detach(), expected["prediction"], atol=1e-5)
        # Rows that are not there weigh nothing, however many of them there are
        assert all(weight == 0 for row, weight in rows[:-1] if row < 0)


def test_the_rows_that_were_selected_are_attended_to_again():
    belief, memory = network(), memory_of(20)
    observations, stamps = th.randn(5, D_O), stamps_of(*((7, copy % 3, 4) for copy in range(5)))
    first = belief(observations, stamps, belief.encode(memory))
    # A longer table, as at the end of a rollout: its first rows are the same
    again = belief(observations, stamps, belief.encode(followed_by(memory, memory_of(30))), first.selected)
    assert th.equal(first.mean, again.mean) and th.equal(first.weights, again.weights)
    anew = belief(observations, stamps, belief.encode(followed_by(memory, memory_of(30))))
    assert not th.equal(first.selected, anew.selected)


def test_scopes_are_kept_apart():
    memory = memory_of(30)
    for n_own, n_pool in ((30, 0), (0, 30), (4, 4)):
        belief = network(n_own, n_pool)
        output = belief(th.randn(3, D_O), stamps_of((11, 0, 8), (11, 1, 8), (11, DEPLOYED, -1)), belief.encode(memory))
        for copy, selected in zip((0, 1, DEPLOYED), output.selected.tolist(), strict=True):
            own = [row for row in selected[:n_own] if row >= 0]
            pool = [row for row in selected[n_own:-1] if row >= 0]
            assert all(memory.stamps[row, 1] == copy for row in own) and all(memory.stamps[row, 1] != copy for row in pool)
            assert memory.valid[own + pool].all() and len(set(own + pool)) == len(own + pool)
            assert bool(own) == (n_own > 0 and copy != DEPLOYED) and bool(pool) == (n_pool > 0)
            assert selected[-1] == -1


@pytest.mark.parametrize("feature", ROW_FEATURES)
def test_a_feature_that_is_switched_off_makes_no_difference(feature):
    """And one that is on does."""
    memory, stamps = memory_of(20), stamps_of((7, 0, 4))
    changed = {
        "own_action": memory._replace(own=memory.own + th.tensor([1.0, 1.0, 0.0])),
        "reward": memory._replace(own=memory.own + th.tensor([0.0, 0.0, 1.0])),
        "age": memory._replace(stamps=memory.stamps - th.tensor([2, 0, 0])),
        "episode": memory._replace(stamps=memory.stamps + th.tensor([0, 0, 4])),
        "copy": memory._replace(stamps=memory.stamps.clone()),
    }[feature]
    if feature == "copy":
        # Other copies than its own are all alike without it: attend to them only, one of which becomes another
        changed.stamps[:, 1] += 1
        stamps = stamps_of((7, 9, -1))
        memory.stamps[:, 1] = 9
        changed.stamps[:, 1] = 8
    observations = th.randn(1, D_O)
    without = [name for name in ROW_FEATURES if name != feature]
    for features, same in ((without, True), (ROW_FEATURES, False)):
        belief = network(20, 20, row_features=features)
        before, after = (belief(observations, stamps, belief.encode(each)) for each in (memory, changed))
        assert th.allclose(before.mean, after.mean, atol=1e-6) == same


def test_gradients_reach_every_weight():
    belief, memory = network(), memory_of(30)
    output = belief(th.randn(6, D_O), stamps_of(*((10, i % 3, 8) for i in range(6))), belief.encode(memory))
    assert output.prediction is not None
    output.prediction.square().sum().backward()
    assert all(weight.grad is not None and weight.grad.any() for weight in belief.parameters())


def test_a_memory_keeps_its_newest_valid_rows():
    memory = newest(followed_by(empty_memory(4, D_O, W, OWN), memory_of(12)), 4)
    assert memory.stamps[:, :2].tolist() == [[2, 1], [2, 2], [3, 1], [3, 2]] and memory.valid.all()
    few = newest(memory_of(3), 5)
    assert few.valid.tolist() == [True] * 3 + [False] * 2 and not few.observations[3:].any()
