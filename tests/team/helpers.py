"""Helpers that several tests of the team share."""

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_belief import team

# Typed as Any, since tests also look at attributes that the public types do not have
Team: Any = team.Team
make_team_env: Any = team.make_team_env

PPO_KWARGS: dict[str, Any] = {
    "n_steps": 8,
    "batch_size": 8,
    "n_epochs": 2,
    "device": "cpu",
    "policy_kwargs": {"net_arch": [8]},
}


def parameters(model):
    """Return a copy of all weights of a model as one vector."""
    return th.nn.utils.parameters_to_vector(model.policy.parameters()).detach().clone()


class Record(BaseCallback):
    """
    Callback that records its events in order, and at each step copies of some of SB3's locals.

    :param keep: Names of the locals
    :param stop_at: Number of the step at which it stops the training, counted from 1. None not to stop it
    """

    def __init__(self, keep=(), stop_at=None):
        super().__init__()
        self.keep, self.stop_at = keep, stop_at
        self.events: list[str] = []
        self.kept: list[dict] = []

    def _on_training_start(self):
        self.events.append("training start")

    def _on_rollout_start(self):
        self.events.append("rollout start")

    def _on_step(self):
        self.events.append("step")
        self.kept.append({key: _copy(self.locals[key]) for key in self.keep})
        return self.n_calls != self.stop_at

    def _on_rollout_end(self):
        self.events.append("rollout end")

    def _on_training_end(self):
        self.events.append("training end")

    @property
    def steps(self):
        """Number of steps so far."""
        return self.events.count("step")


def _copy(value):
    if isinstance(value, np.ndarray):
        return value.copy()
    if isinstance(value, (list, tuple)):
        return [_copy(part) for part in value]
    if isinstance(value, dict):
        return {key: _copy(part) for key, part in value.items()}
    return value
