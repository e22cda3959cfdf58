"""The teams that are measured, made as a user makes them, and the loop that lets one learn and times its phases."""

import importlib.util
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnvWrapper

from benchmarks.measure import Sample
from sb3_belief import BeliefPPO, Team, make_team_env
from sb3_belief.zoo.config import RunConfig, load_config

#: The beliefs that are compared; "ippo" is BeliefPPO without one
ALGOS: dict[str, dict[str, Any]] = {"ippo": {"belief": "none"}, "belief_ppo": {"belief": "dynamic"}}
SPREAD, SPREAD_ENVS = "mpe/simple_spread_v3", 8
PHASES = ("environment", "acting", "update")


def spread_settings(quick: bool) -> dict[str, Any]:
    """Return PPO's arguments for simple_spread; ``quick`` means a tiny rollout and one epoch."""
    n_steps, n_epochs = (8, 1) if quick else (128, 10)
    return dict(n_steps=n_steps, batch_size=SPREAD_ENVS * n_steps // 4, n_epochs=n_epochs)


def spread_team(algo: str, quick: bool) -> Team:
    """
    Return three learners on simple_spread, all with SB3's default networks (64x64 tanh).

    :param algo: ``"ppo"`` (Stable-Baselines3's own), ``"ippo"`` or ``"belief_ppo"``
    :param quick: See ``spread_settings``
    """
    env = make_team_env(SPREAD, n_envs=SPREAD_ENVS)
    settings: dict[str, Any] = dict(seed=0, device="cpu", **spread_settings(quick))
    if algo == "ppo":
        return Team(PPO, "MlpPolicy", env, **settings)
    # The paper's history, although it is the default: it is what is measured
    return Team(BeliefPPO, "BeliefPolicy", env, history_length=800, keep_ratio=0.05, **ALGOS[algo], **settings)


def junction_team(algo: str, quick: bool, **kwargs: Any) -> Team:
    """
    Return ten learners on Traffic Junction (medium) with the settings of zoo_configs/belief_ppo.yml.

    :param algo: ``"ippo"`` or ``"belief_ppo"``
    :param quick: Four copies for eight steps, and one epoch
    :param kwargs: Further arguments of the team
    """
    params = ["n_envs:4", "n_steps:8", "n_epochs:1", "batch_size:16"] if quick else []
    config = load_config("belief_ppo", "traffic-junction-medium", params=params)
    return _from_config(config, algo, **kwargs)


def smax_team(algo: str, quick: bool) -> Team:
    """
    Return eight learners with action masks on SMAX's 3s5z.

    :param algo: ``"ippo"`` or ``"belief_ppo"``
    :param quick: Four copies for ten steps, and one epoch
    """
    sizes = {"n_envs": 64, "n_steps": 50, "batch_size": 800, "n_epochs": 4}
    if quick:
        sizes = {"n_envs": 4, "n_steps": 10, "batch_size": 20, "n_epochs": 1}
    params = [f"{key}:{value}" for key, value in sizes.items()]
    return _from_config(load_config("maskable_belief_ppo", "smax/3s5z", params=params), algo)


def has_smax() -> bool:
    """Return whether SMAX can be measured here."""
    return importlib.util.find_spec("jaxmarl") is not None


def _from_config(config: RunConfig, algo: str, **kwargs: Any) -> Team:
    env = make_team_env(config.env_id, n_envs=config.n_envs, env_kwargs=config.env_kwargs, wrapper=config.wrapper)
    own = {**config.algo_kwargs, **ALGOS[algo], **kwargs}
    return Team(config.algo_class, config.policy, env, seed=0, device="cpu", normalize=config.normalize, **own)


class _StepClock(VecEnvWrapper):
    """Wrapper that notes when each step of a vectorised environment begins and ends."""

    marks: list[tuple[float, float]]

    def mark(self) -> None:
        self.marks.append((time.process_time(), time.perf_counter()))

    def reset(self) -> Any:
        return self.venv.reset()

    def step(self, actions: Any) -> Any:
        self.mark()
        result = self.venv.step(actions)
        self.mark()
        return result

    def step_wait(self) -> Any:
        return self.venv.step_wait()


class TeamLoop:
    """
    Loop that lets a team collect rollouts and learn from them.

    The environment sees when steps begin and end, which is enough to tell three phases apart:

    - ``environment``: within its steps
    - ``acting``: from one step of a rollout to the next, which is all that SB3, the models and the team do there
    - ``update``: from the last step of a rollout to the first of the next one. Choosing the actions of that step is in it, and
      so is what ``learn()`` does when it begins and ends

    :param team: The team, all of whose agents have rollouts of the same length
    :param rollouts: Number of rollouts in each call
    """

    def __init__(self, team: Team, rollouts: int = 1) -> None:
        self.team, self._rollouts = team, rollouts
        env = team.get_env()
        assert env is not None
        self._clock = _StepClock(env)
        team.set_env(self._clock)
        (self._n_steps,) = {model.n_steps for model in team.agents.values()}  # type: ignore[attr-defined]
        #: The phases of each call, with the CPU time of this process only
        self.phases: list[dict[str, Sample]] = []

    def __call__(self) -> int:
        """Learn, and return the number of joint steps, as the team counts them."""
        before, clock = self.team.num_timesteps, self._clock
        clock.marks = []
        clock.mark()
        self.team.learn(self._rollouts * self._n_steps * clock.num_envs, reset_num_timesteps=False)
        if th.cuda.is_initialized():
            # A GPU may still be busy with the last update when Python has gone on
            th.cuda.synchronize()
        clock.mark()
        steps = self.team.num_timesteps - before
        # Seconds by both clocks: a gap before each step of the environment and one after the last, and the steps themselves
        seconds = np.diff(np.array(clock.marks), axis=0)
        gaps, in_env = seconds[::2], seconds[1::2].sum(axis=0)
        update = gaps[:: self._n_steps].sum(axis=0)
        found = dict(zip(PHASES, (in_env, gaps.sum(axis=0) - update, update), strict=True))
        self.phases.append({name: Sample(steps, *map(float, both)) for name, both in found.items()})
        return steps


def milliseconds(phases: Sequence[dict[str, Sample]]) -> dict[str, float]:
    """Return the CPU milliseconds per joint step of each phase, and of all together under ``"total"``."""
    steps = sum(each[PHASES[0]].steps for each in phases)
    found = {name: 1000 * sum(each[name].cpu for each in phases) / steps for name in PHASES}
    return {**found, "total": sum(found.values())}


def time_of(phases: Sequence[dict[str, Sample]], *names: str) -> list[Sample]:
    """Return one sample for each call of a loop, with the time of the named phases only."""
    return [
        Sample(each[names[0]].steps, sum(each[name].cpu for name in names), sum(each[name].wall for name in names))
        for each in phases
    ]
