"""What an agent would do at an observation: the distribution from which its policy draws, and its value."""

import inspect
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm


class OwnChoice(NamedTuple):
    """
    What an agent would do.

    :param kind: ``"probabilities"`` of its actions (for a ``MultiBinary`` space of a one), ``"values"`` of its actions,
        ``"mean"`` of a continuous action, or empty if its policy does not say
    :param numbers: These, encoded as the others' actions are: the parts of the action space side by side
    :param value: Its critic's value of the observation, in the units of the rewards that it learns from; None if it has none
    """

    kind: str
    numbers: np.ndarray
    value: float | None


def own_choice(
    model: BaseAlgorithm,
    observation: Any,
    mask: np.ndarray | None = None,
    state: tuple[np.ndarray, ...] | None = None,
    episode_start: np.ndarray | None = None,
) -> OwnChoice:
    """
    Return what an agent would do at an observation. No random number is drawn.

    :param model: Of the agent. A belief that it samples is taken at its mean
    :param observation: As the model's ``predict`` takes it, ``[1, ...]``
    :param mask: Its possible actions, bool ``[1, k]``, or None
    :param state: Its recurrent state before it acts, or None
    :param episode_start: Where that starts anew, bool ``[1]``
    :return: The choice
    """
    policy: Any = model.policy
    policy.set_training_mode(False)
    with th.no_grad():
        tensor, _ = policy.obs_to_tensor(observation)
        if hasattr(policy, "get_distribution"):
            if hasattr(policy, "lstm_actor"):
                distribution, _ = policy.get_distribution(tensor, *_recurrent_state(policy, state, episode_start))
                # predict() keeps the actor's state only
                value = None
            else:
                masked = mask is not None and "action_masks" in inspect.signature(policy.get_distribution).parameters
                distribution = policy.get_distribution(tensor, **({"action_masks": mask} if masked else {}))
                value = float(policy.predict_values(tensor).flatten()[0])
            kind, numbers = _described(distribution, model.action_space)
            return OwnChoice(kind, numbers, value)
        network = getattr(policy, "q_net", None) or getattr(policy, "quantile_net", None)
        if network is None:
            return OwnChoice("", np.zeros(0), None)
        values = network(tensor)
        # QR-DQN has quantiles of each value, [1, n_quantiles, n_actions]
        values = (values.mean(dim=1) if values.ndim == 3 else values).flatten().cpu().numpy()
        allowed = values if mask is None else values[mask.reshape(-1)]
        return OwnChoice("values", values, float(allowed.max()))


def _recurrent_state(policy: Any, state: tuple[np.ndarray, ...] | None, episode_start: np.ndarray | None) -> Any:
    lstm = policy.lstm_actor
    if state is None:
        zeros = np.zeros((lstm.num_layers, 1, lstm.hidden_size), dtype=np.float32)
        state = (zeros, zeros)
    starts = np.zeros(1) if episode_start is None else episode_start
    tensors = tuple(th.as_tensor(part, dtype=th.float32, device=policy.device) for part in state)
    return tensors, th.as_tensor(starts, dtype=th.float32, device=policy.device)


def _described(distribution: Any, space: spaces.Space) -> tuple[str, np.ndarray]:
    # MultiCategorical distributions hold a list of torch's, SB3's under "distribution" and sb3-contrib's under "distributions"
    inner = getattr(distribution, "distributions", None) or distribution.distribution
    parts = inner if isinstance(inner, list) else [inner]
    if isinstance(space, spaces.Box):
        mean = distribution.mode().flatten()
        # SB3 clips what it draws, unless its policy squashes
        numbers = np.clip(mean.cpu().numpy(), space.low.flatten(), space.high.flatten())
        return "mean", numbers
    probabilities = [part.probs.reshape(-1) for part in parts]
    if isinstance(space, spaces.MultiBinary) and isinstance(inner, list):
        # sb3-contrib masks zeros and ones as two actions each
        probabilities = [part[1:] for part in probabilities]
    return "probabilities", th.cat(probabilities).cpu().numpy()
