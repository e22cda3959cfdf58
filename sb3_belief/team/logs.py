"""Logging of a team: each agent's own series in files, and one table per iteration for all."""

import os
import sys
from collections.abc import Iterable, Sequence
from numbers import Number
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import HumanOutputFormat, KVWriter, Logger, make_output_format
from stable_baselines3.common.utils import get_latest_run_id


def _has_spread(key: str) -> bool:
    """
    :param key: of a logged value
    :return: whether the agents' standard deviation says something besides their mean
    """
    return key in ("rollout/ep_rew_mean", "train/approx_kl") or key.startswith("belief/")


class _Relay(KVWriter):
    """
    Keeps what an agent has dumped last.

    :param agent: name of the agent
    :param log: where it goes
    """

    def __init__(self, agent: str, log: "TeamLog"):
        self._agent, self._log = agent, log

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        self._log.latest[self._agent] = dict(key_values)
        self._log.excluded.update(key_excluded)

    def close(self) -> None:
        """There is nothing to close."""


class TeamLog:
    """
    The loggers of a team and of its agents.

    :param agents: names of the agents
    :param verbose: 1 and more: the team's table goes to the standard output
    :param log_dir: folder of ``progress.csv`` (the team) and ``agents/<agent>/progress.csv``; None: no CSV files
    :param tensorboard_log: folder of the TensorBoard runs: ``Team_<k>`` (the team) and ``Team_<k>/agents/<agent>``; None: none
    """

    def __init__(self, agents: Sequence[str], verbose: int, log_dir: str | None, tensorboard_log: str | None):
        # What each agent has dumped since the last table, and which outputs do not take a key
        self.latest: dict[str, dict[str, Any]] = {}
        self.excluded: dict[str, tuple[str, ...]] = {}
        run_dir = None
        if tensorboard_log is not None:
            run_dir = os.path.join(tensorboard_log, f"Team_{get_latest_run_id(tensorboard_log, 'Team') + 1}")
        self.agent_loggers = {
            agent: Logger(
                None if log_dir is None else os.path.join(log_dir, "agents", agent), _files(log_dir, run_dir, "agents", agent)
            )
            for agent in agents
        }
        self.team_logger = Logger(log_dir, _files(log_dir, run_dir))
        if verbose >= 1:
            self.team_logger.output_formats.append(HumanOutputFormat(sys.stdout))

    def connect(self, agent: str, model: BaseAlgorithm) -> None:
        """
        Give an agent its logger; one that the user has set stays, and is listened to.

        :param agent: name of the agent
        :param model: its model
        """
        if not model._custom_logger:
            model.set_logger(self.agent_loggers[agent])
        model.logger.output_formats.append(_Relay(agent, self))

    def complete(self, learning: Iterable[str]) -> bool:
        """
        :param learning: who still learns
        :return: whether there is something new, and of each of these
        """
        return bool(self.latest) and set(learning) <= self.latest.keys()

    def record_means(self, logger: Logger) -> None:
        """
        Record the means over the agents of what they have dumped since the last time, and standard deviations where these
        say something.

        :param logger: of the team
        """
        values: dict[str, list[float]] = {}
        for dumped in self.latest.values():
            for key, value in dumped.items():
                # Times are the team's own; images, texts and the like stay in the agents' own logs
                if isinstance(value, (Number, np.number)) and not key.startswith("time/"):
                    values.setdefault(key, []).append(float(value))  # type: ignore[arg-type]
        for key, numbers in values.items():
            excluded = self.excluded.get(key)
            logger.record(key, float(np.mean(numbers)), exclude=excluded)
            if _has_spread(key) and len(self.agent_loggers) > 1:
                logger.record(f"{key}_std", float(np.std(numbers)), exclude=excluded)
        self.latest.clear()

    def close(self) -> None:
        """Close the files; the standard output stays open."""
        for logger in [self.team_logger, *self.agent_loggers.values()]:
            logger.close()


def _files(log_dir: str | None, run_dir: str | None, *folder: str) -> list[KVWriter]:
    formats = []
    if log_dir is not None:
        formats.append(make_output_format("csv", os.path.join(log_dir, *folder)))
    if run_dir is not None:
        formats.append(make_output_format("tensorboard", os.path.join(run_dir, *folder)))
    return formats
