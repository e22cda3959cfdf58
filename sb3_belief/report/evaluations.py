"""The evaluations of a run, as its file holds them."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sb3_belief.common.exceptions import first_line

#: The file that SB3's ``EvalCallback`` writes
EVALUATIONS = "evaluations.npz"


@dataclass(frozen=True)
class Evaluations:
    """
    Evaluations of a team while it learned, in which it acted greedily.

    :param steps: Joint steps until each, int ``[k]``
    :param returns: Return of each episode, float ``[k, episodes]``
    :param lengths: Length of each episode, int ``[k, episodes]``
    :param successes: Whether each episode succeeded, float ``[k, episodes]``; NaN in evaluations before the environment
        reported any. None if it never has
    """

    steps: np.ndarray
    returns: np.ndarray
    lengths: np.ndarray
    successes: np.ndarray | None = None

    @property
    def mean_returns(self) -> np.ndarray:
        """Mean return of each evaluation, ``[k]``."""
        return self.returns.mean(axis=1)

    @property
    def success_rates(self) -> np.ndarray:
        """Share of the episodes of each evaluation that succeeded, ``[k]``; NaN where none was reported."""
        return np.full(len(self.steps), np.nan) if self.successes is None else self.successes.mean(axis=1)

    @property
    def best(self) -> int:
        """The evaluation after which SB3 has kept the best model: of equal ones the first."""
        return int(np.argmax(self.mean_returns))

    def rows(self) -> list[dict[str, Any]]:
        """Return their episodes, one after the other, as rows of the table of episodes."""
        kind = {"phase": "training", "checkpoint": "current", "deterministic": True}
        found = []
        for index, steps in enumerate(self.steps):
            successes = None if self.successes is None else self.successes[index]
            played = episode_columns(self.returns[index], successes, self.lengths[index])
            found += [{**kind, "joint_steps": int(steps), **each} for each in played]
        return found


def episode_columns(returns: Any, successes: Any, lengths: Any) -> list[dict[str, Any]]:
    """
    Return the columns of episodes that say how they ended.

    :param returns: Their returns, ``[k]``
    :param successes: Whether they succeeded, ``[k]``, NaN where that is not known; None if it was not reported
    :param lengths: Their lengths, ``[k]``
    :return: ``episode`` (from 0 on), ``episode_return``, ``success`` and ``length`` of each
    """
    return [
        {
            "episode": index,
            "episode_return": float(each),
            "success": None if successes is None or np.isnan(successes[index]) else float(successes[index]),
            "length": int(lengths[index]),
        }
        for index, each in enumerate(returns)
    ]


def read_evaluations(folder: str | os.PathLike[str]) -> Evaluations | None:
    """
    Read ``evaluations.npz``, which SB3's ``EvalCallback`` writes.

    :param folder: Folder of a run
    :return: The evaluations. None if there was none
    :raises ValueError: If the file is damaged
    """
    path = Path(folder) / EVALUATIONS
    if not path.is_file():
        return None
    try:
        with np.load(path, allow_pickle=False) as data:
            steps, lengths = data["timesteps"].astype(np.int64), data["ep_lengths"].astype(np.int64)
            returns = data["results"].astype(np.float64)
            known = data["successes"].astype(np.float64) if "successes" in data else None
        if returns.ndim != 2 or returns.shape != lengths.shape or steps.shape != returns.shape[:1]:
            raise ValueError("its parts have unequal lengths")
        successes = None if known is None else np.full(returns.shape, np.nan)
        if known is not None and successes is not None and known.shape[1:] == returns.shape[1:] and len(known) <= len(returns):
            # Once an environment reports successes, all later evaluations have them
            successes[len(returns) - len(known) :] = known
    # A damaged file makes numpy and zipfile raise whatever they raise
    except Exception as error:
        raise ValueError(f"{path} is damaged ({first_line(error)})") from error
    return Evaluations(steps, returns, lengths, successes) if len(steps) else None
