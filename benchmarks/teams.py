"""The teams that are measured, as a user makes them."""

import importlib.util
from typing import Any

from stable_baselines3 import PPO

from sb3_belief import BeliefPPO, Team, make_team_env
from sb3_belief.zoo.config import RunConfig, load_config

#: The beliefs that are compared; "ippo" is BeliefPPO without one
ALGOS: dict[str, dict[str, Any]] = {"ippo": {"belief": "none"}, "belief_ppo": {"belief": "dynamic"}}
SPREAD, SPREAD_ENVS = "mpe/simple_spread_v3", 8


def spread_settings(quick: bool) -> dict[str, Any]:
    """
    :param quick: a tiny rollout and one epoch
    :return: arguments of PPO for simple_spread
    """
    n_steps, n_epochs = (8, 1) if quick else (128, 10)
    return dict(n_steps=n_steps, batch_size=SPREAD_ENVS * n_steps // 4, n_epochs=n_epochs)


def spread_team(algo: str, quick: bool) -> Team:
    """
    :param algo: ``"ppo"`` (Stable-Baselines3's own), ``"ippo"`` or ``"belief_ppo"``
    :param quick: see ``spread_settings``
    :return: three learners on simple_spread, all with SB3's default networks (64x64 tanh)
    """
    env = make_team_env(SPREAD, n_envs=SPREAD_ENVS)
    settings: dict[str, Any] = dict(seed=0, device="cpu", **spread_settings(quick))
    if algo == "ppo":
        return Team(PPO, "MlpPolicy", env, **settings)
    # The paper's history, written out since it is what is measured
    return Team(BeliefPPO, "BeliefPolicy", env, history_length=800, keep_ratio=0.05, **ALGOS[algo], **settings)


def junction_team(algo: str, quick: bool, **kwargs: Any) -> Team:
    """
    :param algo: ``"ippo"`` or ``"belief_ppo"``
    :param quick: four copies for eight steps, and one epoch
    :param kwargs: further arguments of the team
    :return: ten learners on Traffic Junction (medium), both with the settings of zoo_configs/belief_ppo.yml
    """
    params = ["n_envs:4", "n_steps:8", "n_epochs:1", "batch_size:16"] if quick else []
    config = load_config("belief_ppo", "traffic-junction-medium", params=params)
    return _from_config(config, algo, **kwargs)


def smax_team(algo: str, quick: bool) -> Team:
    """
    :param algo: ``"ippo"`` or ``"belief_ppo"``, both with action masks
    :param quick: four copies for ten steps, and one epoch
    :return: eight learners on SMAX's 3s5z
    """
    sizes = {"n_envs": 64, "n_steps": 50, "batch_size": 800, "n_epochs": 4}
    if quick:
        sizes = {"n_envs": 4, "n_steps": 10, "batch_size": 20, "n_epochs": 1}
    params = [f"{key}:{value}" for key, value in sizes.items()]
    return _from_config(load_config("maskable_belief_ppo", "smax/3s5z", params=params), algo)


def has_smax() -> bool:
    """
    :return: whether SMAX can be measured here
    """
    return importlib.util.find_spec("jaxmarl") is not None


def _from_config(config: RunConfig, algo: str, **kwargs: Any) -> Team:
    env = make_team_env(config.env_id, n_envs=config.n_envs, env_kwargs=config.env_kwargs, wrapper=config.wrapper)
    own = {**config.algo_kwargs, **ALGOS[algo], **kwargs}
    return Team(config.algo_class, config.policy, env, seed=0, device="cpu", normalize=config.normalize, **own)


class TeamLoop:
    """
    Rollouts of a team and the updates after them.

    :param team: what learns
    :param rollouts: how many of them in each call
    """

    def __init__(self, team: Team, rollouts: int = 1) -> None:
        self.team = team
        # What SB3 collects before each update
        models = team.agents.values()
        self._total = rollouts * max(model.n_steps * model.n_envs for model in models)  # type: ignore[attr-defined]

    def __call__(self) -> int:
        """
        :return: joint steps that were done, as the team counts them
        """
        before = self.team.num_timesteps
        self.team.learn(self._total, reset_num_timesteps=False)
        return self.team.num_timesteps - before
