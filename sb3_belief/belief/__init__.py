"""The belief about the other agents, in pure PyTorch: nothing here knows of Stable-Baselines3."""

from sb3_belief.belief.history import History, append_rows, empty_history
from sb3_belief.belief.layout import ActionLayout
from sb3_belief.belief.loss import action_loss, kl_divergence
from sb3_belief.belief.network import BeliefOutput, DynamicBelief, HistoryContext, n_kept

__all__ = [
    "ActionLayout",
    "BeliefOutput",
    "DynamicBelief",
    "History",
    "HistoryContext",
    "action_loss",
    "append_rows",
    "empty_history",
    "kl_divergence",
    "n_kept",
]
