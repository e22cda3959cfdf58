"""
Does it pay to know the type of the scripted others? Each arm trains with the YAML entry of its algorithm.

    python -m studies.gate aisle-sides --seeds 0 1
    python -m studies.gate aisle-sides-kinds --seeds 0 1 --arms told blind

``told`` is IPPO whose learners observe the type, ``blind`` the same without, and ``dynamic`` BeliefPPO. The score of a seed is
the return of the episodes in the last half of the training: the mean over the types of what each has brought, so that it does
not depend on how often which was drawn.
"""

import argparse
import time
from collections import defaultdict
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_belief import Team, make_team_env
from sb3_belief.zoo.config import load_config

ARMS = {"told": ("ippo", True), "blind": ("ippo", False), "dynamic": ("belief_ppo", False)}


class ReturnsByType(BaseCallback):
    """
    Records the episodes' returns by the type that was there at their end.

    :param after: Number of joint steps before the first that counts
    """

    def __init__(self, after: int):
        super().__init__()
        self.after = after
        self.returns: dict[str, list[float]] = defaultdict(list)

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "episode" in info and self.num_timesteps > self.after:
                self.returns[info["partner"]].append(info["episode"]["r"])
        return True

    @property
    def score(self) -> float:
        """The mean over the types of their mean returns."""
        return float(np.mean([np.mean(found) for found in self.returns.values()]))


def train(env_id: str, arm: str, seed: int, params: list[str], env_kwargs: list[str], n_timesteps: int | None) -> float:
    """Train one arm with one seed, and return its score."""
    algo, told = ARMS[arm]
    config = load_config(algo, env_id, params=params, env_kwargs=env_kwargs)
    kwargs: dict[str, Any] = {**config.env_kwargs, "reveal_partner": told, "partner_seed": seed}
    env = make_team_env(env_id, n_envs=config.n_envs, seed=seed, env_kwargs=kwargs)
    steps = n_timesteps or config.n_timesteps
    recorded = ReturnsByType(steps // 2)
    Team(config.algo_class, config.policy, env, seed=seed, **config.algo_kwargs).learn(steps, callback=recorded)
    return recorded.score


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("env", help="id of an environment with hidden types")
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=list(ARMS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1])
    parser.add_argument("-n", "--n-timesteps", type=int, help="joint steps, instead of the YAML entry's")
    parser.add_argument("-params", nargs="+", default=[], metavar="K:V", help="settings of the algorithm")
    parser.add_argument("--env-kwargs", nargs="+", default=[], metavar="K:V", help="arguments of the environment")
    args = parser.parse_args()
    th.set_num_threads(1)
    for arm in args.arms:
        for seed in args.seeds:
            start = time.process_time()
            score = train(args.env, arm, seed, args.params, args.env_kwargs, args.n_timesteps)
            print(f"{args.env} {arm} seed {seed}: {score:.2f} ({time.process_time() - start:.0f} CPU s)", flush=True)


if __name__ == "__main__":
    main()
