"""A team that is saved holds nothing that is not finite."""

from collections.abc import Mapping

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from sb3_belief.team.finite.statistics import bad_statistics
from sb3_belief.team.finite.tensors import ModelTensors, Snapshot


def check_finite(models: Mapping[str, BaseAlgorithm], statistics: Mapping[str, VecNormalize]) -> None:
    """
    Check that models and their normalisation are finite.

    :param models: By agent
    :param statistics: Normalisation of the agents that have one, by agent
    :raises ValueError: If a parameter, a moment of an optimizer or a statistic is not finite; the message names agent and
        tensor
    """
    for agent, model in models.items():
        now = Snapshot()
        bad = {} if now.take(ModelTensors(model)) else now.bad_tensors()
        spoilt = {f"{name} of its normalisation": "it is not finite" for name in bad_statistics(statistics.get(agent))}
        for name, what in (bad | spoilt).items():
            more = len(bad | spoilt) - 1
            raise ValueError(
                f"The team is not saved, because agent {agent!r} would be of no use: {name}: {what}"
                f"{f', and {more} more are not either' if more else ''}. A training stops before that, or with on_nan='skip'"
                " takes such updates back; so this was set from outside, or comes from a file. Load an earlier team."
            )
