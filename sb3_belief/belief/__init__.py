"""The belief about the other agents, in pure PyTorch: nothing here knows of Stable-Baselines3."""

from sb3_belief.belief.adaptive import ROW_FEATURES, AdaptiveBelief
from sb3_belief.belief.history import History, append_rows, empty_history
from sb3_belief.belief.layout import ActionLayout
from sb3_belief.belief.loss import ACTION_LOSSES, cross_entropy, expected_actions, kl_divergence, squared_error
from sb3_belief.belief.network import SIMILARITIES, BeliefOutput, DynamicBelief, HistoryContext, filled_rows, n_selected
from sb3_belief.belief.variants import ADAPTIVE, VARIANTS, Variant

__all__ = [
    "ACTION_LOSSES",
    "ADAPTIVE",
    "ROW_FEATURES",
    "SIMILARITIES",
    "VARIANTS",
    "ActionLayout",
    "AdaptiveBelief",
    "BeliefOutput",
    "DynamicBelief",
    "History",
    "HistoryContext",
    "Variant",
    "append_rows",
    "cross_entropy",
    "empty_history",
    "expected_actions",
    "filled_rows",
    "kl_divergence",
    "n_selected",
    "squared_error",
]
