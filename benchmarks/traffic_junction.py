"""
Joint steps per CPU second of the Traffic Junction: the batched core against single copies.

Run with ``python benchmarks/traffic_junction.py``. What is compared takes turns, so that a busy machine is unfair to
nobody, and medians are printed. Observations, rewards, infos and resets are all in it; the actions are random and drawn
beforehand.
"""

import argparse
import time
from collections.abc import Callable
from statistics import median

import numpy as np

from sb3_belief.envs import TrafficJunction
from sb3_belief.envs.traffic_junction.vec_env import TrafficJunctionVecEnv


def batched(n_envs: int, n_steps: int, level: str) -> Callable[[], float]:
    """
    :param n_envs: number of copies in one core
    :param n_steps: steps per measurement
    :param level: level of the environment
    :return: a function that measures joint steps per CPU second
    """
    env = TrafficJunctionVecEnv(n_envs, level=level)
    env.seed(0)
    env.reset()
    draws = np.random.default_rng(0).integers(0, 2, size=(n_steps, len(env.possible_agents), n_envs))
    actions = [dict(zip(env.possible_agents, draw, strict=True)) for draw in draws]

    def measure() -> float:
        start = time.process_time()
        for joint in actions:
            env.step(joint)
        return n_steps * n_envs / (time.process_time() - start)

    return measure


def singles(n_envs: int, n_steps: int, level: str) -> Callable[[], float]:
    """
    :param n_envs: number of environments, stepped one after the other
    :param n_steps: steps per measurement of each
    :param level: level of the environment
    :return: a function that measures joint steps per CPU second
    """
    envs = [TrafficJunction(level) for _ in range(n_envs)]
    for i, env in enumerate(envs):
        env.reset(seed=i)
    agents = envs[0].possible_agents
    draws = np.random.default_rng(0).integers(0, 2, size=(n_steps, n_envs, len(agents))).tolist()
    actions = [[dict(zip(agents, draw, strict=True)) for draw in step] for step in draws]

    def measure() -> float:
        start = time.process_time()
        for step in actions:
            for env, joint in zip(envs, step, strict=True):
                env.step(joint)
                # the batch tells who saw whom in every step as well
                env.visibility()
                if not env.agents:
                    env.reset()
        return n_steps * n_envs / (time.process_time() - start)

    return measure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--level", default="medium", help="level of the environment")
    parser.add_argument("--steps", type=int, default=400, help="steps of every copy per measurement")
    parser.add_argument("--repeats", type=int, default=7, help="measurements of each; the median counts")
    args = parser.parse_args()
    measures = {
        "eight single copies": singles(8, args.steps, args.level),
        "one core of 1 copy": batched(1, args.steps, args.level),
        "one core of 8 copies": batched(8, args.steps, args.level),
        "one core of 64 copies": batched(64, args.steps, args.level),
    }
    figures: dict[str, list[float]] = {name: [] for name in measures}
    for repeat in range(args.repeats + 1):
        for name, measure in measures.items():
            figure = measure()
            if repeat > 0:  # the first round warms up
                figures[name].append(figure)
    medians = {name: median(values) for name, values in figures.items()}
    print(f"Traffic Junction {args.level}, joint steps per CPU second (median of {args.repeats}, lowest to highest):")
    for name, values in figures.items():
        print(f"  {name:22s} {medians[name]:9,.0f}   ({min(values):,.0f} to {max(values):,.0f})")
    single = medians["eight single copies"]
    for name in ("one core of 8 copies", "one core of 64 copies"):
        print(f"  {name} / eight single copies: {medians[name] / single:.1f}")


if __name__ == "__main__":
    main()
