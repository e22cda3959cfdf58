"""
The belief of the paper (Sec. 4, eq. 3 to 8) once more: numpy in double precision, one row and one number at a time.

Written from the paper's text, with the resolutions that the documentation of the algorithm gives where that is unclear; it
shares no code with the package, only the names of the weights.
"""

import math
from typing import NamedTuple

import numpy as np

#: A weight by its name, as the network calls it
Weights = dict[str, np.ndarray]
ATTENDING, SAMPLING, PREDICTING = (
    {"dynamic", "context"},
    {"dynamic", "variational"},
    {"dynamic", "context", "variational", "static"},
)


class Other(NamedTuple):
    """
    One of the others.

    :param kind: "discrete", "multi_discrete", "multi_binary" or "box": what its actions are
    :param sizes: The number of values of each component of a discrete or multi-discrete action; one number, that of the
        components, for the rest
    """

    kind: str
    sizes: tuple[int, ...]

    @property
    def width(self) -> int:
        return sum(self.sizes)


class Belief(NamedTuple):
    """What is believed of one observation: vectors, None for what the variant does not have."""

    latent: np.ndarray
    mean: np.ndarray
    log_std: np.ndarray | None
    prediction: np.ndarray | None
    kept: list[int]
    attention: list[float]


def linear(weights: Weights, name: str, x: np.ndarray) -> np.ndarray:
    """A linear layer, with or without a bias."""
    matrix, bias = weights[f"{name}.weight"], weights.get(f"{name}.bias")
    result = []
    for row in range(len(matrix)):
        total = 0.0 if bias is None else float(bias[row])
        for column in range(len(x)):
            total += float(matrix[row, column]) * float(x[column])
        result.append(total)
    return np.array(result)


def observation_embedding(weights: Weights, observation: np.ndarray) -> np.ndarray:
    """f_o, two layers with a ReLU between them."""
    hidden = linear(weights, "observation_embedding.0", observation)
    return linear(weights, "observation_embedding.2", np.array([max(0.0, value) for value in hidden]))


def cosine(a: np.ndarray, b: np.ndarray) -> float:
    """S of eq. 3; a vector without a direction is similar to nothing."""
    length = math.sqrt(sum(value**2 for value in a)) * math.sqrt(sum(value**2 for value in b))
    return 0.0 if length == 0 else sum(x * y for x, y in zip(a, b, strict=True)) / length


def similarities(weights: Weights, similarity: str, observation: np.ndarray, history: np.ndarray) -> list[float]:
    """S between an observation and each row of the history, on the embeddings (eq. 3) or on the observations (Fig. 5b)."""
    if similarity == "observation":
        return [cosine(observation, row) for row in history]
    embedding = observation_embedding(weights, observation)
    return [cosine(embedding, observation_embedding(weights, row)) for row in history]


def most_similar(similarity: list[float], keep_ratio: float) -> list[int]:
    """K of eq. 3: the share p of the rows, at least one, by falling similarity."""
    n_selected = min(len(similarity), max(1, round(keep_ratio * len(similarity))))
    return sorted(range(len(similarity)), key=lambda row: -similarity[row])[:n_selected]


def scale(width: int) -> float:
    """By what the inner products of the attention are divided."""
    return math.sqrt(width)


def deviation(log_std: float) -> float:
    """Sigma of eq. 5."""
    return math.exp(log_std)


def belief(
    weights: Weights,
    variant: str,
    observation: np.ndarray,
    history_observations: np.ndarray,
    history_actions: np.ndarray,
    noise: np.ndarray | None,
    kept: list[int],
) -> Belief:
    """
    Eq. 4 and 5 and the prediction, for one observation.

    :param kept: K of eq. 3, the rows to attend to
    """
    own = observation_embedding(weights, observation)
    context, attention = own.copy(), []
    if variant in ATTENDING and kept:
        query, scores, values = linear(weights, "query", own), [], []
        for row in kept:
            state = observation_embedding(weights, history_observations[row])
            state = state + linear(weights, "action_embedding", history_actions[row])
            key = linear(weights, "key", state)
            scores.append(sum(q * k for q, k in zip(query, key, strict=True)) / scale(len(query)))
            values.append(linear(weights, "value", state))
        highest = max(scores)
        total = sum(math.exp(score - highest) for score in scores)
        attention = [math.exp(score - highest) / total for score in scores]
        for weight, value in zip(attention, values, strict=True):
            context = context + weight * value
    if variant == "wide":
        hidden = np.array([max(0.0, value) for value in linear(weights, "encoder.0", context)])
        latent = linear(weights, "encoder.2", hidden)
        return Belief(latent, latent, None, None, [], [])
    encoded = linear(weights, "encoder", context)
    log_std: np.ndarray | None = None
    if variant in SAMPLING:
        half = len(encoded) // 2
        mean = encoded[:half]
        log_std = np.array([min(2.0, max(-5.0, value)) for value in encoded[half:]])
        latent = mean.copy()
        if noise is not None:
            for i in range(half):
                latent[i] += deviation(float(log_std[i])) * float(noise[i])
    else:
        latent = mean = encoded
    return Belief(latent, mean, log_std, linear(weights, "decoder", latent), list(kept), attention)


def flat_action(other: Other, action: np.ndarray) -> list[float]:
    """An action as the belief is given it: one-hot component by component, or the numbers themselves."""
    action = np.asarray(action).reshape(-1)
    if other.kind in ("discrete", "multi_discrete"):
        return [float(value == chosen) for size, chosen in zip(other.sizes, action, strict=True) for value in range(size)]
    return [float(value) for value in action]


def action_loss(name: str, predictions: np.ndarray, actions: list[list[np.ndarray]], visible: np.ndarray, others: list[Other]):
    """
    Eq. 7 over a batch: the error of each visible other's action, averaged over all of them; 0 where nobody is visible.

    :param name: "mse", or "cross_entropy" in its place
    :param actions: For each row of the batch and each other the action it took, not flattened
    """
    total, count = 0.0, 0
    for b in range(len(predictions)):
        start = 0
        for j, other in enumerate(others):
            part = predictions[b, start : start + other.width]
            start += other.width
            if visible[b, j]:
                total += squared(other, part, actions[b][j]) if name == "mse" else minus_log(other, part, actions[b][j])
                count += 1
    return total / max(1, count)


def squared(other: Other, part: np.ndarray, action: np.ndarray) -> float:
    return sum((u - p) ** 2 for u, p in zip(flat_action(other, action), part, strict=True))


def minus_log(other: Other, part: np.ndarray, action: np.ndarray) -> float:
    """The negative log-likelihood of one action, given logits."""
    action, result, start = np.asarray(action).reshape(-1), 0.0, 0
    if other.kind == "multi_binary":
        for logit, taken in zip(part, action, strict=True):
            of_one = 1 / (1 + math.exp(-logit))
            result -= math.log(of_one if taken else 1 - of_one)
        return result
    for size, chosen in zip(other.sizes, action, strict=True):
        odds = [math.exp(logit) for logit in part[start : start + size]]
        result -= math.log(odds[int(chosen)] / sum(odds))
        start += size
    return result


def kl(means: np.ndarray, log_stds: np.ndarray) -> float:
    """D_KL(N(mu, sigma^2) || N(0, 1)) of eq. 6, summed over the latent, averaged over the batch."""
    total = 0.0
    for mean, log_std in zip(means, log_stds, strict=True):
        for m, s in zip(mean, log_std, strict=True):
            total += -s + (math.exp(s) ** 2 + m**2) / 2 - 0.5
    return total / len(means)


def belief_loss(beliefs: list[Belief], variant: str, alpha: float, beta: float, loss: str, actions, visible, others) -> float:
    """What eq. 8 adds to PPO's loss."""
    if variant not in PREDICTING:
        return 0.0
    result = alpha * action_loss(loss, np.array([row.prediction for row in beliefs]), actions, visible, others)
    if variant in SAMPLING:
        result += beta * kl(np.array([row.mean for row in beliefs]), np.array([row.log_std for row in beliefs]))
    return result
