"""Helpers that the tests of the baselines share."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import numpy as np
import torch as th
from torch.nn import functional

# Small enough to learn in a moment
Q_KWARGS: dict[str, Any] = {
    "learning_rate": 1e-3,
    "learning_starts": 10,
    "batch_size": 16,
    "buffer_size": 200,
    "train_freq": 2,
    "target_update_interval": 20,
    "exploration_fraction": 0.5,
    "policy_kwargs": {"net_arch": [8]},
    "device": "cpu",
}


@contextmanager
def recorded_targets() -> Iterator[list[np.ndarray]]:
    """Within the block, keep the target of each update of a Q-learner, as SB3's ``train()`` hands it to its loss."""
    targets: list[np.ndarray] = []
    loss = functional.smooth_l1_loss

    def record(values: th.Tensor, target: th.Tensor) -> th.Tensor:
        targets.append(target.detach().cpu().numpy().ravel().copy())
        return loss(values, target)

    with patch("stable_baselines3.dqn.dqn.F.smooth_l1_loss", record):
        yield targets


def targets_of(model: Any) -> np.ndarray:
    """
    Return the targets of all learnable rows, by one update of SB3's own ``train()`` that changes nothing.

    :param model: A Q-learner
    :return: float ``[n_rows, n_envs]``, NaN where there is nothing to learn
    """
    buffer = model.replay_buffer
    rows, copies = np.nonzero(buffer.learnable[: buffer.size()])
    weights = {name: value.clone() for name, value in model.policy.state_dict().items()}
    optimizer, updates = model.policy.optimizer.state_dict(), model._n_updates
    with (
        recorded_targets() as targets,
        patch.object(buffer, "sample", lambda *_, env=None: buffer.samples_of(rows, copies, env)),
    ):
        model.train(gradient_steps=1, batch_size=len(rows))
    model.policy.load_state_dict(weights)
    model.policy.optimizer.load_state_dict(optimizer)
    model._n_updates = updates
    found = np.full((buffer.size(), buffer.n_envs), np.nan)
    found[rows, copies] = targets[0]
    return found
