"""
Joint steps per CPU second of SMAX: the batch of copies in one compiled step against the same copies stepped one by one.

Run with ``python benchmarks/smax.py`` where jaxmarl is installed. Compiling is not in it: every measurement is made once
beforehand. What is compared takes turns, so that a busy machine is unfair to nobody, and medians are printed. Observations,
masks, visibility, rewards, infos and resets are all in it; the policy is random among what the masks allow, and choosing is
in it too, the same for both.
"""

import argparse
import time
from collections.abc import Callable
from statistics import median

import numpy as np

from sb3_belief.envs.adapters.smax import make, make_batched


def random_actions(masks: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """
    :param masks: bool [..., k]
    :param generator: of random numbers
    :return: possible actions, int [...]
    """
    return (generator.random(masks.shape) * masks).argmax(axis=-1)


def batched(map_name: str, n_envs: int, n_steps: int) -> Callable[[], float]:
    """
    :param map_name: SMAX's map
    :param n_envs: number of copies in one batch
    :param n_steps: steps of the batch per measurement
    :return: a function that measures joint steps per CPU second
    """
    env = make_batched(map_name, n_envs)
    env.seed(0)
    env.reset()
    generator = np.random.default_rng(0)

    def measure() -> float:
        start = time.process_time()
        for _ in range(n_steps):
            chosen = random_actions(np.stack(list(env.action_masks().values())), generator)
            env.step(dict(zip(env.possible_agents, chosen, strict=True)))
        return n_steps * n_envs / (time.process_time() - start)

    return measure


def singles(map_name: str, n_envs: int, n_steps: int) -> Callable[[], float]:
    """
    :param map_name: SMAX's map
    :param n_envs: number of environments, stepped one after the other
    :param n_steps: steps of each per measurement
    :return: a function that measures joint steps per CPU second
    """
    envs = [make(map_name) for _ in range(n_envs)]
    infos = [env.reset(seed=i)[1] for i, env in enumerate(envs)]
    generator = np.random.default_rng(0)

    def measure() -> float:
        start = time.process_time()
        for _ in range(n_steps):
            for i, env in enumerate(envs):
                masks = np.stack([info["action_mask"] for info in infos[i].values()])
                chosen = random_actions(masks, generator).tolist()
                infos[i] = env.step(dict(zip(env.possible_agents, chosen, strict=True)))[-1]
                # the batch tells who saw whom in every step as well
                env.visibility()
                if not env.agents:
                    infos[i] = env.reset()[1]
        return n_steps * n_envs / (time.process_time() - start)

    return measure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--map", default="3s5z", help="SMAX's map")
    parser.add_argument("--steps", type=int, default=100, help="steps of every copy per measurement")
    parser.add_argument("--repeats", type=int, default=5, help="measurements of each; the median counts")
    args = parser.parse_args()
    sizes = (8, 64)
    measures: dict[str, Callable[[], float]] = {}
    for n_envs in sizes:
        measures[f"{n_envs} copies one by one"] = singles(args.map, n_envs, args.steps)
        measures[f"{n_envs} copies at once"] = batched(args.map, n_envs, args.steps)
    figures: dict[str, list[float]] = {name: [] for name in measures}
    for repeat in range(args.repeats + 1):
        for name, measure in measures.items():
            figure = measure()
            if repeat > 0:  # the first round compiles and warms up
                figures[name].append(figure)
    medians = {name: median(values) for name, values in figures.items()}
    print(f"smax/{args.map}, joint steps per CPU second (median of {args.repeats}, lowest to highest):")
    for name, values in figures.items():
        print(f"  {name:21s} {medians[name]:9,.0f}   ({min(values):,.0f} to {max(values):,.0f})")
    for n_envs in sizes:
        ratio = medians[f"{n_envs} copies at once"] / medians[f"{n_envs} copies one by one"]
        print(f"  {n_envs} at once / one by one: {ratio:.1f}")


if __name__ == "__main__":
    main()
