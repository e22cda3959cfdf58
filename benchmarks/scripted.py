"""Steps of one learner among nine scripted cars: part ``scripted`` of the benchmark (``benchmarks/bench.py``)."""

import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv

from benchmarks.measure import Loop, ratio
from benchmarks.report import Report
from sb3_belief import AgentEnv, make_team_env
from sb3_belief.envs.traffic_junction.core import GAS

N_ENVS = 32


def drive_on(obs: np.ndarray) -> int:
    """Return the action of a partner that costs nothing, so that what is measured is the way to it."""
    return GAS


def in_batch(n_steps: int) -> Loop:
    """Return a loop over steps of one learner in ``junction-cultures-medium``."""
    env = make_team_env("junction-cultures-medium", n_envs=N_ENVS, seed=0)
    env.reset()
    rng = np.random.default_rng(0)

    def loop() -> int:
        for _ in range(n_steps):
            env.step({"car_0": rng.integers(2, size=N_ENVS)})
        return n_steps * N_ENVS

    return loop


def by_callables(n_steps: int, n_envs: int = 2) -> Loop:
    """Return a loop over steps of one learner in ``AgentEnv``, with nine callables that cost nothing."""
    partners = {f"car_{i}": drive_on for i in range(1, 10)}
    envs = DummyVecEnv([lambda: AgentEnv("traffic-junction-medium", "car_0", partners)] * n_envs)
    envs.seed(0)
    envs.reset()
    rng = np.random.default_rng(0)

    def loop() -> int:
        for _ in range(n_steps):
            envs.step(rng.integers(2, size=n_envs))
        return n_steps * n_envs

    return loop


def run(report: Report) -> None:
    """
    Measure part ``scripted``.

    :param report: Where it is told
    """
    report.title("scripted", "one learner among nine scripted cars, traffic-junction-medium")
    n_steps = 10 if report.quick else 200
    loops: dict[str, Loop] = {"nine callables": by_callables(n_steps), "junction-cultures": in_batch(n_steps)}
    callables, batch = report.measure("scripted", loops).values()
    report.add_ratio("scripted_vs_callables", ratio(batch, callables), "junction-cultures / AgentEnv with nine callables")
