"""What the evaluations of a run say, an episode a row: those during its training, and the final ones."""

import random
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_belief.common.safe_files.trust import Trust
from sb3_belief.report.evaluations import episode_columns, read_evaluations
from sb3_belief.report.learning_curve import read_monitor
from sb3_belief.team import Team, TeamVecEnv
from sb3_belief.team.agent_models import env_seed
from sb3_belief.zoo.config import RunConfig
from sb3_belief.zoo.errors import cause
from sb3_belief.zoo.evaluate import evaluate
from sb3_belief.zoo.run_folder import BEST_MODEL, TEAM, read_record
from sb3_belief.zoo.train import make_env


def final_seed(seed: int) -> int:
    """
    Return the seed of the final episodes of a run. Neither its training nor its evaluations use them.

    It is the same for all algorithms with the same seed, so that they meet the same episodes as far as the environment allows.

    :param seed: Seed of the run
    :return: Seed of the environment, in [2**30, 1.5 * 2**30)
    """
    # All other seeds of environments are below 2**30
    return 2**30 + env_seed(seed, purpose=3) // 2


def episode_rows(
    cell: dict[str, Any], config: RunConfig, run: Path, extra_packages: tuple[str, ...] = ()
) -> list[dict[str, Any]]:
    """
    Return all episodes of a run's evaluations, and play the final ones.

    :param cell: The record of its cell
    :param config: Its configuration
    :param run: Its folder, in which the training has finished
    :param extra_packages: See ``Team.load`` (``allow_packages``)
    :return: A dictionary an episode, with the columns of the table
    :raises ValueError: If a file of the run is damaged
    """
    common = {
        "study": cell["study"],
        "arm": cell["arm"],
        "algorithm": cell["algo"],
        "environment": cell["env"],
        "seed": cell["seed"],
    }
    if cell.get("online_every") is not None:
        return [{**common, **row} for row in online_rows(run, cell["online_every"], cell["final_episodes"])]
    rows, best_steps, reports_success = _training_rows(run)
    trained = read_record(run).get("timesteps", cell["n_timesteps"])
    checkpoints = [("last", TEAM, trained)]
    if best_steps is not None:
        checkpoints.append(("best", BEST_MODEL, best_steps))
    options = cell["options"]
    settings = replace(config, env_kwargs={**config.env_kwargs, **config.eval_env_kwargs})
    with closing(make_env(settings, options["n_eval_envs"], final_seed(cell["seed"]), evaluation=True)) as env:
        for checkpoint, file, steps in checkpoints:
            team = _load(run / file, env, options["device"], extra_packages)
            for deterministic in (True, False):
                # As the evaluations of the training knew it, so that each of these counts the same episodes
                env.reports_success = env.reports_success or reports_success
                played = _play(team, env, cell["final_episodes"], deterministic, final_seed(cell["seed"]))
                kind = {"phase": "final", "checkpoint": checkpoint, "deterministic": deterministic, "joint_steps": int(steps)}
                rows += [{**kind, **each} for each in played]
    return [{**common, **row} for row in rows]


def online_rows(run: Path, every: int, n_final: int) -> list[dict[str, Any]]:
    """
    Return the episodes that a team played while it learned, with sampled actions.

    :param run: Folder of the run
    :param every: Joint steps between the points of a curve, each of which has the episodes that ended since the last one
    :param n_final: How many of the last episodes count as the final evaluation of the last weights
    :return: A dictionary an episode
    :raises ValueError: If the monitor file is damaged
    """
    ends, returns, successes = read_monitor(run)
    lengths = np.diff(ends, prepend=0).astype(np.int64)
    won = None if np.isnan(successes).any() else successes
    rows = []
    for first in range(0, int(ends[-1]) - every + 1 if len(ends) else 0, every):
        inside = (ends > first) & (ends <= first + every)
        kind = {"phase": "training", "checkpoint": "current", "deterministic": False, "joint_steps": first + every}
        rows += [
            {**kind, **each}
            for each in episode_columns(returns[inside], None if won is None else won[inside], lengths[inside])
        ]
    last = slice(max(len(ends) - n_final, 0), None)
    kind = {"phase": "final", "checkpoint": "last", "deterministic": False, "joint_steps": int(ends[-1]) if len(ends) else 0}
    return rows + [
        {**kind, **each} for each in episode_columns(returns[last], None if won is None else won[last], lengths[last])
    ]


def _training_rows(run: Path) -> tuple[list[dict[str, Any]], int | None, bool]:
    """Return the rows of the evaluations during the training, the steps of the best, and whether they have successes."""
    try:
        evaluations = read_evaluations(run)
    except ValueError as error:
        raise ValueError(f"{error}: move the folder of the run away to train it again.") from error
    if evaluations is None:
        return [], None, False
    best = int(evaluations.steps[evaluations.best]) if (run / BEST_MODEL).is_file() else None
    return evaluations.rows(), best, evaluations.successes is not None


def _load(path: Path, env: TeamVecEnv, device: str, extra_packages: tuple[str, ...]) -> Team:
    try:
        return Team.load(path, env=env, device=device, **Trust.of(False, extra_packages)._asdict())
    # A damaged file makes zipfile, json and torch raise whatever they raise
    except Exception as error:
        raise ValueError(f"{path} cannot be loaded: {cause(error)}") from error


def _play(team: Team, env: TeamVecEnv, n_episodes: int, deterministic: bool, seed: int) -> list[dict[str, Any]]:
    # Sampled actions come from the global generators, and environments may use them, too
    random.seed(seed)
    np.random.seed(seed)
    th.manual_seed(seed)
    env.seed(seed)
    outcome = evaluate(team, env, n_episodes, deterministic)
    won = outcome.successes if outcome.successes.size == outcome.returns.size else None
    return episode_columns(outcome.returns, won, outcome.lengths)
