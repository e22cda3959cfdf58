"""Play episodes and count."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from sb3_contrib.common.maskable.evaluation import evaluate_policy as evaluate_masked
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_belief.team import TeamVecEnv


@dataclass(frozen=True)
class Outcome:
    """
    :param returns: team return of each episode
    :param successes: whether each episode succeeded; empty if the environment does not say
    """

    returns: np.ndarray
    successes: np.ndarray

    @property
    def success_rate(self) -> float | None:
        """Share of the episodes that succeeded, or None if the environment does not say."""
        return float(self.successes.mean()) if self.successes.size else None

    @property
    def standard_error(self) -> float | None:
        """Standard error of the success rate."""
        rate = self.success_rate
        return None if rate is None else float(np.sqrt(rate * (1 - rate) / self.successes.size))


def evaluate(player: Any, env: TeamVecEnv, n_episodes: int, deterministic: bool = True) -> Outcome:
    """
    :param player: a ``Team``, or anything with its ``predict``
    :param env: where to play; evaluated from a reset on
    :param n_episodes: number of episodes, shared out evenly among the copies so that short ones are not preferred
    :param deterministic: whether the player does what it thinks best, or samples
    :return: what came out
    """
    successes: list[bool] = []

    def note(locals_: dict[str, Any], _: dict[str, Any]) -> None:
        # called at each step of the episodes that count
        if locals_["done"] and "is_success" in locals_["info"]:
            successes.append(bool(locals_["info"]["is_success"]))

    # The environment's masks hold wherever a model takes them
    run = evaluate_masked if getattr(player, "takes_masks", False) else evaluate_policy
    returns, _ = run(
        player, env, n_eval_episodes=n_episodes, deterministic=deterministic, callback=note, return_episode_rewards=True
    )
    return Outcome(np.asarray(returns, dtype=float), np.asarray(successes, dtype=bool))
