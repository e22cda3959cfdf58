"""Why an update may have failed: what is looked at, in this order, when loss or parameters are not finite."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer

from sb3_belief.team.finite.tensors import ModelTensors, Snapshot

# Squares of more than this are near the end of what a float32 holds, once they are multiplied with weights or summed up
_HUGE_DATA = 1e9
_HUGE_PARAMETER = 1e3
_HIGH_LEARNING_RATE = 0.1
# Of a logarithm: e ** 20 is 5e8
_HUGE_LOG = 20.0
_DATA = (
    ("rewards", "rewards", "scale them down (normalize=True does)"),
    ("observations", "observations", "scale them down (normalize=True does)"),
    ("next_observations", "observations", "scale them down (normalize=True does)"),
    ("actions", "actions", "they come from the policy: bound or scale the action space"),
)
_LOGS = (
    ("log_std", "the standard deviation of the actions has left all bounds: lower ent_coef or learning_rate"),
    ("log_ent_coef", "the automatic ent_coef has left all bounds: set it to a number, or lower learning_rate"),
)


def likely_cause(tensors: ModelTensors, finite: Snapshot | None) -> str:
    """
    Say what has probably made an update fail.

    :param tensors: Of the model, with the parameters that it had before
    :param finite: These parameters, if they are known
    :return: A sentence without its full stop
    """
    model = tensors.model
    for cause in (_of_critic(tensors, finite), _of_data(model), _of_step_size(tensors, finite), _of_logarithms(tensors)):
        if cause is not None:
            return cause
    return (
        "none of the usual ones (rewards, observations and parameters are of usual size, and so is learning_rate ="
        f" {_learning_rate(tensors):.3g}). Of a loss or a network of your own, torch.autograd.set_detect_anomaly(True) shows"
        " which operation it is"
    )


def cause_in_rollout(tensors: ModelTensors) -> str | None:
    """
    Say why a policy may have failed to choose actions.

    :param tensors: Of the model
    :return: A sentence without its full stop; None if nothing is unusual
    """
    observations = _size(tensors.model._last_obs)
    if observations is not None and not observations < _HUGE_DATA:
        return f"the present observations {_reach(observations)}: scale them down (normalize=True does)"
    now = Snapshot()
    now.take(tensors)
    return _of_step_size(tensors, now)


def _of_critic(tensors: ModelTensors, finite: Snapshot | None) -> str | None:
    """Look first for huge values of a critic, since SB3 adds them to the rewards of a rollout where a time limit ends it."""
    for name, buffer in _buffers(tensors.model):
        size = _size(getattr(buffer, "values", None))
        if size is not None and not size < _HUGE_DATA:
            return _of_step_size(tensors, finite) or (
                f"the values that the critic predicts in its {name} {_reach(size)}: earlier updates have led it astray, lower"
                " learning_rate"
            )
    return None


def _of_data(model: BaseAlgorithm) -> str | None:
    huge = None
    for name, buffer in _buffers(model):
        for attribute, what, advice in _DATA:
            size = _size(getattr(buffer, attribute, None), _n_rows(buffer))
            if size is not None and not size < _HUGE_DATA:
                cause = f"the {what} in its {name} {_reach(size)}: {advice}"
                if not np.isfinite(size):
                    return cause
                huge = huge or cause
    return huge


def _of_step_size(tensors: ModelTensors, finite: Snapshot | None) -> str | None:
    rate = _learning_rate(tensors)
    largest, name = (0.0, "") if finite is None else finite.largest()
    if rate < _HIGH_LEARNING_RATE and largest < _HUGE_PARAMETER:
        return None
    size = f", and {name} had reached {largest:.3g} before" if largest >= _HUGE_PARAMETER else ""
    clipping = getattr(tensors.model, "max_grad_norm", None)
    return (
        f"the steps of its optimizer are too large: learning_rate is {rate:.3g},"
        f" {'gradients are not clipped' if clipping is None else f'max_grad_norm {clipping:.3g}'}{size}: lower learning_rate"
        f"{'' if clipping is None else ' or max_grad_norm'}"
    )


def _of_logarithms(tensors: ModelTensors) -> str | None:
    for place in tensors.places():
        for ending, text in _LOGS:
            if place.name.rpartition(".")[2] == ending:
                size = _size(place.tensor.cpu().numpy())
                if size is not None and not size < _HUGE_LOG:
                    return f"{place.name} {_reach(size)}: {text}"
    return None


def _learning_rate(tensors: ModelTensors) -> float:
    rates = [group["lr"] for _, optimizer in tensors.optimizers() for group in optimizer.param_groups if "lr" in group]
    return float(max(rates, default=0.0))


def _buffers(model: BaseAlgorithm) -> Iterator[tuple[str, BaseBuffer]]:
    for value in vars(model).values():
        if isinstance(value, BaseBuffer):
            yield "replay buffer" if isinstance(value, ReplayBuffer) else "rollout", value


def _n_rows(buffer: BaseBuffer) -> int | None:
    return None if buffer.full or not isinstance(buffer, ReplayBuffer) else buffer.pos


def _size(data: Any, n_rows: int | None = None) -> float | None:
    """Return the largest absolute value in arrays, nan if there is one; None if they hold no floats."""
    if isinstance(data, Mapping):
        sizes = [size for each in data.values() if (size := _size(each, n_rows)) is not None]
        return None if not sizes else float(np.max(sizes))
    if not isinstance(data, np.ndarray) or data.dtype.kind != "f" or not data[:n_rows].size:
        return None
    # Without a copy, since a replay buffer may be most of the memory
    return float(np.maximum(data[:n_rows].max(), -data[:n_rows].min()))


def _reach(size: float) -> str:
    return f"reach {size:.3g}" if np.isfinite(size) else f"are not finite ({size})"
