"""Returns and success rates of a team, measured by playing episodes."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from sb3_contrib.common.maskable.evaluation import evaluate_policy as evaluate_masked
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv


@dataclass(frozen=True)
class Outcome:
    """
    Results of episodes that were played.

    :param returns: The team's return of each episode, float ``[k]``
    :param successes: Whether each episode succeeded, bool ``[k]``. Empty if the environment does not report successes
    :param lengths: Number of joint steps of each episode, int ``[k]``. Empty if nobody counted them
    """

    returns: np.ndarray
    successes: np.ndarray
    lengths: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=np.int64))

    @property
    def success_rate(self) -> float | None:
        """Fraction of the episodes that succeeded, or None if the environment does not report successes."""
        return float(self.successes.mean()) if self.successes.size else None

    @property
    def standard_error(self) -> float | None:
        """Standard error of the success rate, or None if there is none."""
        rate = self.success_rate
        return None if rate is None else float(np.sqrt(rate * (1 - rate) / self.successes.size))


def evaluate(model: Any, env: VecEnv, n_episodes: int, deterministic: bool = True) -> Outcome:
    """
    Play episodes from a reset on and return their results.

    :param model: A ``Team``, or any object with a ``predict`` like its own
    :param env: Environment of the team to play in, with or without wrappers
    :param n_episodes: Number of episodes. Each copy plays the same share of them, so that short episodes are not preferred
    :param deterministic: Whether the agents act greedily. Otherwise they sample their actions
    :return: The results
    """
    successes: list[bool] = []

    def record_success(locals_: dict[str, Any], _: dict[str, Any]) -> None:
        # SB3's evaluation returns no successes. It calls this at each step of the episodes that count
        if locals_["done"] and "is_success" in locals_["info"]:
            successes.append(bool(locals_["info"]["is_success"]))

    # Only sb3-contrib's evaluation passes the environment's action masks on
    run = evaluate_masked if getattr(model, "takes_masks", False) else evaluate_policy
    returns, lengths = run(
        model,
        env,
        n_eval_episodes=n_episodes,
        deterministic=deterministic,
        callback=record_success,
        return_episode_rewards=True,
    )
    return Outcome(np.asarray(returns, dtype=float), np.asarray(successes, dtype=bool), np.asarray(lengths, dtype=np.int64))
