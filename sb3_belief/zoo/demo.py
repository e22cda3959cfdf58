"""The demo (``make demo``), in which a team learns to cross a junction and is measured before and after."""

import os
import shutil
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.panel import Panel
from rich.table import Table

from sb3_belief.envs import registry
from sb3_belief.envs.traffic_junction.policies import Policy, RandomPolicy, RulePolicy, all_gas
from sb3_belief.report.learning_curve import plot_learning_curve
from sb3_belief.vec_env.team_vec_env import TeamObs
from sb3_belief.zoo.config import RunConfig, load_config
from sb3_belief.zoo.enjoy import EnjoyOptions, enjoy
from sb3_belief.zoo.evaluate import Outcome, evaluate
from sb3_belief.zoo.run_folder import TEAM
from sb3_belief.zoo.train import TrainOptions, make_env, make_team, train

ALGO, ENV_ID = "belief_ppo", "traffic-junction-medium"
# Seed of episodes that occur neither in the training nor in its evaluations. All policies meet the same traffic
MEASURE_SEED = 5_000_000
MEASURE_ENVS = 64


class ScriptedTeam:
    """
    Adapter that gives a policy without training the method ``predict`` of a team.

    :param policy: Callable that maps {agent: observations} to {agent: actions}
    """

    def __init__(self, policy: Policy) -> None:
        self._policy = policy

    def predict(self, observation: TeamObs, state: Any = None, **_: Any) -> tuple[TeamObs, Any]:
        """
        Return the policy's actions.

        :param observation: {agent: array [n_envs, width]}
        :param state: Not used
        :return: Actions by agent, and the state as it was given
        """
        return self._policy(observation), state


def demo(n_timesteps: int, episodes: int, seed: int, log_folder: str, command: list[str]) -> int:
    """
    Train ``belief_ppo`` on ``traffic-junction-medium`` by its YAML entry, and show what it has learned.

    :param n_timesteps: Number of joint steps to train for
    :param episodes: Number of episodes of each measurement
    :param seed: Seed of the team and its environments
    :param log_folder: Folder of all runs
    :param command: The words of the command line, recorded in ``run.json``
    :return: Exit status: 0, or that of the signal that ended the training (130 after Ctrl-C)
    """
    console = Console()
    config = load_config(ALGO, ENV_ID, n_timesteps=n_timesteps)
    setting = f"{ENV_ID} at arrival rate {config.env_kwargs['arrival_rate']}"
    options = TrainOptions(
        seed=seed,
        log_folder=log_folder,
        eval_freq=max(n_timesteps // 8, 1),
        # One episode per copy. A call of the ten networks takes about as long for many rows as for few, so this saves time
        n_eval_envs=TrainOptions.eval_episodes,
        progress=True,
        verbose=0,
        command=command,
    )
    console.print(
        Panel.fit(
            f"Ten cars, each a [bold]{ALGO}[/] agent of its own that sees 3x3 cells, learn to\n"
            "cross a junction. They share no weights, buffers or observations.\n\n"
            f"environment  {setting}\n"
            f"training     {n_timesteps:,} joint steps\n"
            f"settings     {config.source}",
            title="sb3-belief demo",
        )
    )
    with console.status("Measuring random, all gas, the 3x3 rule and the untrained team"):
        rates = {name: _measure(config, ScriptedTeam(policy), episodes) for name, policy in _baselines(config).items()}
        rates["before"] = _measure_untrained(config, options, seed, episodes)
    console.print(f"Before: success rate {rates['before'].success_rate:.3f}. Training (Ctrl-C ends it and saves):")

    start = time.monotonic()
    result = train(config, options)
    seconds = time.monotonic() - start
    if not result.finished:
        return result.exit_status
    with console.status("Measuring the trained team, drawing"):
        rates["after"] = _measure(config, result.team, episodes)
        curve = plot_learning_curve(
            result.folder,
            result.folder / "learning_curve.png",
            bars={name: outcome.success_rate or 0.0 for name, outcome in rates.items() if name not in ("before", "after")},
            title=f"{ALGO} on {setting}, seed {seed}",
        )
    video = result.folder / "episode.gif"
    enjoy(EnjoyOptions(str(result.folder), seed=MEASURE_SEED, output=str(video)))
    console.print(_table(rates, seconds, episodes))
    console.print(_next_steps(result.folder, curve, video), soft_wrap=True)
    return 0


def _baselines(config: RunConfig) -> dict[str, Policy]:
    env_kwargs = {**registry.spec(ENV_ID).kwargs, **config.env_kwargs}
    # The seed differs from those of the copies, so that a random team does not draw the numbers that decide the traffic
    return {"random": RandomPolicy(MEASURE_SEED - 1), "all gas": all_gas, "3x3 rule": RulePolicy(**env_kwargs)}


def _measure(config: RunConfig, model: Any, episodes: int) -> Outcome:
    env = make_env(config, MEASURE_ENVS, MEASURE_SEED)
    try:
        return evaluate(model, env, episodes)
    finally:
        env.close()


def _measure_untrained(config: RunConfig, options: TrainOptions, seed: int, episodes: int) -> Outcome:
    env = make_env(config, config.n_envs, seed)
    try:
        # With the same seed this is the team that the training starts with
        return _measure(config, make_team(config, options, env, seed), episodes)
    finally:
        env.close()


def _table(rates: Mapping[str, Outcome], seconds: float, episodes: int) -> Table:
    names = {
        "before": f"{ALGO} before training",
        "after": f"{ALGO} after {seconds:.0f} s",
    }
    table = Table(title=f"Episodes without a collision, of {episodes}", caption="greedy; ± standard error")
    table.add_column("policy")
    table.add_column("success rate", justify="right")
    table.add_column("")
    for name, outcome in sorted(rates.items(), key=lambda item: item[1].success_rate or 0.0):
        rate, error = outcome.success_rate or 0.0, outcome.standard_error or 0.0
        style = "bold green" if name == "after" else "bold" if name == "before" else None
        table.add_row(names.get(name, name), f"{rate:.3f} ± {error:.3f}", "█" * round(25 * rate), style=style)
    return table


def _next_steps(folder: Path, curve: Path, video: Path) -> str:
    # The commands must work as they are printed, even if the virtual environment that runs the demo is not activated
    bin_folder = "" if shutil.which("sb3-belief") else f"{os.path.relpath(Path(sys.executable).parent)}/"
    return "\n".join(
        [
            "",
            f"Learning curve  {curve}",
            f"An episode      {video}",
            f"The team        {folder / TEAM}",
            "",
            "[bold]Next[/]",
            "[dim]# watch the team in a window[/]",
            f"{bin_folder}sb3-belief enjoy {folder}",
            "[dim]# continue its training[/]",
            f"{bin_folder}sb3-belief train -i {folder} -P --verbose 0",
            "[dim]# the same agents without a belief[/]",
            f"{bin_folder}sb3-belief train --algo ippo --env {ENV_ID} -P --verbose 0",
        ]
    )
