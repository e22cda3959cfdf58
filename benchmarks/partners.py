"""
What do partners in a team cost?

One car of Traffic Junction (medium) learns, and nine are partners. Its actions are constant, so that what is measured is the
environment with its partners: one saved team against a pool of four, the same one in all copies or another in each, where
every partner makes four passes a step; and nine functions of batches in a team against callables in an ``AgentEnv``.
"""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

from benchmarks.measure import Loop, ratio
from benchmarks.report import Report
from sb3_belief import AgentEnv, Team, make_team_env
from sb3_belief.team import PartnerPool, PartnersVecEnv, batched

ENV, LEARNER, N_ENVS = "traffic-junction-medium", "car_0", 32
PARTNERS = [f"car_{i}" for i in range(1, 10)]


def brakes(obs: np.ndarray) -> int:
    """Brake if the observation's mean is positive: as cheap as a function that looks at it can be."""
    return int(obs.mean() > 0)


@batched
def all_brake(obs: np.ndarray) -> np.ndarray:
    """Do the same in all copies."""
    return (obs.mean(axis=1) > 0).astype(int)


def stepping(env: Any, actions: Any, n_steps: int) -> Loop:
    """Return a loop over steps of an environment."""
    env.reset()

    def loop() -> int:
        for _ in range(n_steps):
            env.step(actions)
        return n_steps * env.num_envs

    return loop


def run(report: Report) -> None:
    """Measure part ``partners``."""
    report.title("partners", f"one learner and nine partners on {ENV}, {N_ENVS} copies")
    n_envs, n_steps = (4, 4) if report.quick else (N_ENVS, 40)
    actions = np.zeros(n_envs, dtype=int)
    with tempfile.TemporaryDirectory() as folder:
        teams = {f"team {seed}": str(Path(folder, f"{seed}.zip")) for seed in range(4)}
        for seed, path in enumerate(teams.values()):
            Team(PPO, "MlpPolicy", make_team_env(ENV), seed=seed, device="cpu", n_steps=8, batch_size=8).save(path)

        def partnered(partner: Any) -> Loop:
            env = PartnersVecEnv(make_team_env(ENV, n_envs=n_envs, seed=0), dict.fromkeys(PARTNERS, partner))
            return stepping(env, {LEARNER: actions}, n_steps)

        kwargs = {"parallel_env": ENV, "agent": LEARNER, "partners": dict.fromkeys(PARTNERS, brakes)}
        alone = make_vec_env(AgentEnv, n_envs=n_envs, seed=0, env_kwargs=kwargs)
        loops = {
            "one saved team": partnered(teams["team 0"]),
            "a pool of four, the same in all copies": partnered(PartnerPool(teams, 1, "rollouts", per_copy=False)),
            "a pool of four, another in each copy": partnered(PartnerPool(teams)),
            "nine functions of batches": partnered(all_brake),
            "AgentEnv with nine callables": stepping(alone, actions, n_steps),
        }
        samples = report.measure("partners", loops)
    one, pool, per_copy, functions, single = samples.values()
    report.add_ratio("pool_vs_one_team", ratio(pool, one), "pool of four saved teams, the same in all copies / one team")
    report.add_ratio("pool_per_copy_vs_one_team", ratio(per_copy, one), "pool of four, another in each copy / one team")
    report.add_ratio("partners_vs_agent_env", ratio(functions, single), "functions of batches / AgentEnv with callables")
