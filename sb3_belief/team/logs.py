"""Logging of a team: each agent's own values go to files, and their means into one table per iteration."""

import os
import sys
import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from numbers import Number
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import HumanOutputFormat, KVWriter, Logger
from stable_baselines3.common.utils import get_latest_run_id, safe_mean
from stable_baselines3.common.vec_env import VecEnv

from sb3_belief.common.file_names import file_name
from sb3_belief.team.finite import SKIPPED
from sb3_belief.team.log_files import counters, open_logger, put_counters_back, sync_logger, table_state

#: Beside how many partners, the last that were met, the mean returns are logged
MOST_PARTNERS = 20


def _has_spread(key: str) -> bool:
    """
    Return whether the standard deviation over the agents is logged besides their mean.

    :param key: Key of a logged value
    """
    return key in ("rollout/ep_rew_mean", "train/approx_kl") or key.startswith("belief/")


class _WholeKeys(HumanOutputFormat):
    """SB3's table, in which keys are never cut: SB3 raises an error where two are equal then, as paths of partners may be."""

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        self.max_length = max([36, *map(len, key_values)])
        super().write(key_values, key_excluded, step)


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


class _Iterations(KVWriter):
    """
    Writer that corrects an agent's number of iterations for those that come after it, where a training has been continued.

    SB3 counts them from one in each ``learn()``.
    """

    _KEY = "time/iterations"

    def __init__(self) -> None:
        self._before, self._counted = 0, 0

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        if self._KEY in key_values:
            if key_values[self._KEY] <= self._counted:
                # A further learn()
                self._before = 0
            self._counted = key_values[self._KEY]
            key_values[self._KEY] += self._before

    def close(self) -> None:
        """Do nothing: no file is open."""

    @property
    def shown(self) -> int:
        """The number that was written last."""
        return self._before + self._counted

    def go_on_from(self, shown: int) -> None:
        """
        Count on.

        :param shown: The number that was written last
        """
        self._before, self._counted = shown, 0


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
    :param continue_from: What ``state`` returned, for a run that goes on from there: with the same files, of which later rows
        are dropped, and the same TensorBoard run. Where there are no such files, new ones begin
    :raises ValueError: If a file is not the one that it was then
    """

    def __init__(
        self,
        agents: Sequence[str],
        verbose: int,
        log_dir: str | None,
        tensorboard_log: str | None,
        run_name: str = "Team",
        continue_from: Mapping[str, Any] | None = None,
    ):
        self.run_name = run_name if continue_from is None else str(continue_from["run_name"])
        # Values that each agent has dumped since the last table, and the outputs from which each key is excluded
        self.latest: dict[str, dict[str, Any]] = {}
        self._algorithms: dict[str, str] = {}
        # How many updates of each agent have been taken back, of those of which any has
        self._skipped: dict[str, int] = {}
        self.excluded: dict[str, tuple[str, ...]] = {}
        before = continue_from or {}
        # The folder of the TensorBoard run, and the first step of which a run before this one shows nothing in it
        self._run: str | None = None
        purge_step = None
        if tensorboard_log is not None:
            if before.get("run") is None:
                self._run = f"{run_name}_{get_latest_run_id(tensorboard_log, run_name) + 1}"
            else:
                self._run, purge_step = str(before["run"]), before["timesteps"] + 1
                if self._run != os.path.basename(self._run):
                    raise ValueError(f"The name of a TensorBoard run is that of a folder, not {self._run!r}.")

        def logger(table: Mapping[str, Any] | None, *folder: str) -> Logger:
            event_folder = None if self._run is None else os.path.join(str(tensorboard_log), self._run, *folder)
            return open_logger(None if log_dir is None else os.path.join(log_dir, *folder), event_folder, table, purge_step)

        tables = before.get("agent_tables", {})
        self.agent_loggers = {agent: logger(tables.get(agent), "agents", file_name(agent)) for agent in agents}
        self.team_logger = logger(before.get("team_table"))
        # Those that the models use, which the user may have set
        self._used = dict(self.agent_loggers)
        self._iterations: dict[str, _Iterations] = {}
        if verbose >= 1:
            self.team_logger.output_formats.append(_WholeKeys(sys.stdout))

    def connect(self, agent: str, model: BaseAlgorithm) -> None:
        """
        Give an agent its logger, and have its values reach the team's table.

        A logger that the user has set on the model stays; its values reach the table too.

        :param agent: Name of the agent
        :param model: Its model
        """
        if not model._custom_logger:
            model.set_logger(self.agent_loggers[agent])
        self._iterations[agent] = _Iterations()
        model.logger.output_formats.insert(0, self._iterations[agent])
        model.logger.output_formats.append(_LatestValues(agent, self))
        self._algorithms[agent] = type(model).__name__
        self._used[agent] = model.logger

    def complete(self, learning: Iterable[str]) -> bool:
        """
        Return whether the agents have dumped what the next table needs.

        :param learning: Names of the agents that are still learning
        :return: Whether each of them, and at least one agent, has dumped values since the last table
        """
        return bool(self.latest) and set(learning) <= self.latest.keys()

    def record_means(self, logger: Logger) -> None:
        """
        Record the means over the agents of the values dumped since the last table, for some also the standard deviations, and
        the number of updates that were taken back.

        What different algorithms record in training cannot be compared: ``train/loss`` becomes ``train/PPO/loss`` and
        ``train/DQN/loss`` in a team of both.

        :param logger: Logger of the team
        """
        values: dict[str, list[float]] = {}
        keys: dict[str, str] = {}
        # In the order of the team, and not of who was first, on which the last bits of a mean would depend
        for agent in filter(self.latest.__contains__, self.agent_loggers):
            for key, value in self.latest[agent].items():
                if key == SKIPPED:
                    self._skipped[agent] = int(value)
                    continue
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
        if self._skipped:
            # The number of all agents, also of those that have finished
            logger.record(SKIPPED, sum(self._skipped.values()))
        self.latest.clear()

    def _shown(self, agent: str, key: str) -> str:
        """Return the key under which a value of an agent enters the team's table."""
        group, _, name = key.partition("/")
        if group != "train" or len(set(self._algorithms.values())) == 1:
            return key
        return f"train/{self._algorithms[agent]}/{name}"

    def state(self, timesteps: int) -> dict[str, Any]:
        """
        Return how far the logs are, and what waits to be written, for a run that goes on from here.

        :param timesteps: Number of the team's timesteps
        :return: Plain data: numbers, texts, arrays, lists and dicts
        """
        return {
            "run_name": self.run_name,
            "run": self._run,
            "timesteps": timesteps,
            "team_table": table_state(self.team_logger),
            "agent_tables": {agent: table_state(logger) for agent, logger in self.agent_loggers.items()},
            "team_counters": counters(self.team_logger),
            "agent_counters": {agent: counters(logger) for agent, logger in self._used.items()},
            "iterations": {agent: iterations.shown for agent, iterations in self._iterations.items()},
            # Of which the means will be logged, of nothing else
            "latest": {
                agent: {key: float(value) for key, value in values.items() if isinstance(value, (Number, np.number))}  # type: ignore[arg-type]
                for agent, values in self.latest.items()
            },
            "skipped": dict(self._skipped),
            "excluded": {key: list(outputs or ()) for key, outputs in self.excluded.items()},
        }

    def put_back(self, state: Mapping[str, Any]) -> None:
        """
        Have the loggers hold what waited to be written.

        :param state: What ``state`` returned
        """
        put_counters_back(self.team_logger, state["team_counters"])
        for agent, logger in self._used.items():
            put_counters_back(logger, state["agent_counters"][agent])
        for agent, iterations in self._iterations.items():
            iterations.go_on_from(state["iterations"][agent])
        self.latest.clear()
        self._skipped.update(state["skipped"])
        self.latest.update({agent: dict(values) for agent, values in state["latest"].items()})
        self.excluded.update({key: tuple(outputs) for key, outputs in state["excluded"].items()})

    def sync(self) -> None:
        """Have the system write to the disk what it holds of the files."""
        for logger in (self.team_logger, *self.agent_loggers.values()):
            sync_logger(logger)

    def close(self) -> None:
        """Close the files, but not the standard output."""
        for logger in [self.team_logger, *self.agent_loggers.values()]:
            logger.close()


def record_statistics(
    logger: Logger, episodes: Sequence[dict[str, Any]], successes: Collection[bool], env: VecEnv | None = None
) -> None:
    """
    Record the means over the last episodes, of all and beside each partner, and how often copies of the environment have been
    made anew, if any have.

    :param logger: Logger of the team
    :param episodes: What ``info["episode"]`` said of them, and beside which ``partner`` they ended, if the environment says so
    :param successes: Whether they were successes, as far as the environment says so
    :param env: The team's environment
    """
    if episodes:
        logger.record("rollout/ep_rew_mean", safe_mean([episode["r"] for episode in episodes]))
        logger.record("rollout/ep_len_mean", safe_mean([episode["l"] for episode in episodes]))
    returns: dict[str, list[float]] = {}
    for episode in reversed(episodes):
        # The last ones met, since a pool may have any number of partners
        if "partner" in episode and (episode["partner"] in returns or len(returns) < MOST_PARTNERS):
            returns.setdefault(episode["partner"], []).append(episode["r"])
    for name in sorted(returns):
        logger.record(f"partners/{name}/ep_rew_mean", safe_mean(returns[name]))
    if successes:
        logger.record("rollout/success_rate", safe_mean(list(successes)))
    if env is not None and (restarts := getattr(env.unwrapped, "n_restarts", 0)):
        logger.record("rollout/worker_restarts", restarts)


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
