"""Logging of a team: each agent's own values go to files, and their means into one table per iteration."""

import os
import sys
import time
from collections.abc import Collection, Iterable, Sequence
from numbers import Number
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import HumanOutputFormat, KVWriter, Logger, make_output_format
from stable_baselines3.common.utils import get_latest_run_id, safe_mean

from sb3_belief.common.file_names import file_name


def _has_spread(key: str) -> bool:
    """
    Return whether the standard deviation over the agents is logged besides their mean.

    :param key: Key of a logged value
    """
    return key in ("rollout/ep_rew_mean", "train/approx_kl") or key.startswith("belief/")


class _LatestValues(KVWriter):
    """
    Writer that passes the values of an agent's logger to the team's log, which keeps the latest of each key.

    :param agent: Name of the agent
    :param log: The team's log
    """

    def __init__(self, agent: str, log: "TeamLog"):
        self._agent, self._log = agent, log

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        # Off-policy algorithms write once for each episode that ends in a step, and only the first time what train() recorded
        self._log.latest.setdefault(self._agent, {}).update(key_values)
        self._log.excluded.update(key_excluded)

    def close(self) -> None:
        """Do nothing: no file is open."""


class TeamLog:
    """
    The loggers of a team and of its agents.

    :param agents: Names of the agents
    :param verbose: 1 or more prints the team's table to the standard output
    :param log_dir: Folder for ``progress.csv`` (the team) and ``agents/<agent>/progress.csv``; None for no CSV files. A name
        that cannot be part of a path is quoted (see ``file_name``)
    :param tensorboard_log: Folder for the TensorBoard runs ``<run_name>_<k>`` (the team) and
        ``<run_name>_<k>/agents/<agent>``; None for none
    :param run_name: Name of the run
    """

    def __init__(
        self,
        agents: Sequence[str],
        verbose: int,
        log_dir: str | None,
        tensorboard_log: str | None,
        run_name: str = "Team",
    ):
        self.run_name = run_name
        # Values that each agent has dumped since the last table, and the outputs from which each key is excluded
        self.latest: dict[str, dict[str, Any]] = {}
        self._algorithms: dict[str, str] = {}
        self.excluded: dict[str, tuple[str, ...]] = {}
        run_dir = None
        if tensorboard_log is not None:
            run_dir = os.path.join(tensorboard_log, f"{run_name}_{get_latest_run_id(tensorboard_log, run_name) + 1}")
        self.agent_loggers = {
            agent: Logger(
                None if log_dir is None else os.path.join(log_dir, "agents", file_name(agent)),
                _files(log_dir, run_dir, "agents", file_name(agent)),
            )
            for agent in agents
        }
        self.team_logger = Logger(log_dir, _files(log_dir, run_dir))
        if verbose >= 1:
            # Longer keys than SB3's own: it refuses two that are equal when they are cut
            self.team_logger.output_formats.append(HumanOutputFormat(sys.stdout, max_length=100))

    def connect(self, agent: str, model: BaseAlgorithm) -> None:
        """
        Give an agent its logger, and have its values reach the team's table.

        A logger that the user has set on the model stays; its values reach the table too.

        :param agent: Name of the agent
        :param model: Its model
        """
        if not model._custom_logger:
            model.set_logger(self.agent_loggers[agent])
        model.logger.output_formats.append(_LatestValues(agent, self))
        self._algorithms[agent] = type(model).__name__

    def complete(self, learning: Iterable[str]) -> bool:
        """
        Return whether the agents have dumped what the next table needs.

        :param learning: Names of the agents that are still learning
        :return: Whether each of them, and at least one agent, has dumped values since the last table
        """
        return bool(self.latest) and set(learning) <= self.latest.keys()

    def record_means(self, logger: Logger) -> None:
        """
        Record the means over the agents of the values dumped since the last table, for some also the standard deviations.

        What different algorithms record in training cannot be compared: ``train/loss`` becomes ``train/PPO/loss`` and
        ``train/DQN/loss`` in a team of both.

        :param logger: Logger of the team
        """
        values: dict[str, list[float]] = {}
        keys: dict[str, str] = {}
        for agent, dumped in self.latest.items():
            for key, value in dumped.items():
                # The team records times itself; images, texts and the like are only in the agents' own logs
                if isinstance(value, (Number, np.number)) and not key.startswith("time/"):
                    shown = self._shown(agent, key)
                    keys[shown] = key
                    values.setdefault(shown, []).append(float(value))  # type: ignore[arg-type]
        for shown, numbers in values.items():
            excluded = self.excluded.get(keys[shown])
            logger.record(shown, float(np.mean(numbers)), exclude=excluded)
            if _has_spread(keys[shown]) and len(numbers) > 1:
                logger.record(f"{shown}_std", float(np.std(numbers)), exclude=excluded)
        self.latest.clear()

    def _shown(self, agent: str, key: str) -> str:
        """Return the key under which a value of an agent enters the team's table."""
        group, _, name = key.partition("/")
        if group != "train" or len(set(self._algorithms.values())) == 1:
            return key
        return f"train/{self._algorithms[agent]}/{name}"

    def close(self) -> None:
        """Close the files, but not the standard output."""
        for logger in [self.team_logger, *self.agent_loggers.values()]:
            logger.close()


def record_statistics(logger: Logger, episodes: Collection[dict[str, Any]], successes: Collection[bool]) -> None:
    """
    Record the means over the last episodes.

    :param logger: Logger of the team
    :param episodes: What ``info["episode"]`` said of them
    :param successes: Whether they were successes, as far as the environment says so
    """
    if episodes:
        logger.record("rollout/ep_rew_mean", safe_mean([episode["r"] for episode in episodes]))
        logger.record("rollout/ep_len_mean", safe_mean([episode["l"] for episode in episodes]))
    if successes:
        logger.record("rollout/success_rate", safe_mean(list(successes)))


def record_time(logger: Logger, iterations: int, num_timesteps: int, start_timesteps: int, start_time: int) -> None:
    """
    Record how far and how fast a team has learned.

    :param logger: Logger of the team
    :param iterations: Number of tables so far, this one included
    :param num_timesteps: Number of timesteps so far
    :param start_timesteps: Their number at the beginning of this ``learn()``
    :param start_time: When it began, in nanoseconds
    """
    elapsed = max((time.time_ns() - start_time) / 1e9, sys.float_info.epsilon)
    logger.record("time/iterations", iterations, exclude="tensorboard")
    logger.record("time/fps", int((num_timesteps - start_timesteps) / elapsed))
    logger.record("time/time_elapsed", int(elapsed), exclude="tensorboard")
    logger.record("time/total_timesteps", num_timesteps, exclude="tensorboard")


def _files(log_dir: str | None, run_dir: str | None, *folder: str) -> list[KVWriter]:
    formats = []
    if log_dir is not None:
        formats.append(make_output_format("csv", os.path.join(log_dir, *folder)))
    if run_dir is not None:
        formats.append(make_output_format("tensorboard", os.path.join(run_dir, *folder)))
    return formats
