"""
One agent is saved, loaded without its team, and adapts to each new partner by watching it, without a gradient step.

    python examples/deploy_one_agent.py
"""

import itertools
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_belief import BeliefPPO, Team, make_team_env

CUES = np.arange(3)


def train_and_save(total_timesteps: int, path: Path) -> None:
    """Train a follower to play what its leader plays at each of three cues, and save the follower."""
    env = make_team_env("convention-swap", n_envs=25, seed=0, env_kwargs={"m": 3})
    # The convention of the leader changes after every second rollout. The history holds one rollout, hence one
    # convention. The steps are independent of each other, hence gamma=0
    kwargs: dict[str, Any] = {"n_steps": 16, "batch_size": 200, "n_epochs": 4, "learning_rate": 1e-3, "gamma": 0.0}
    team = Team(BeliefPPO, "BeliefPolicy", env, seed=0, ent_coef=0.01, history_length=400, **kwargs)
    team.learn(total_timesteps).agents["follower"].save(path)


def main(total_timesteps: int = 30_000) -> dict[str, float]:
    """Deploy a trained follower beside each possible leader, and return the numbers that are printed."""
    with tempfile.TemporaryDirectory() as folder:
        train_and_save(total_timesteps, Path(folder) / "follower.zip")
        follower = BeliefPPO.load(Path(folder) / "follower.zip")

    before, after = [], []
    for leader in map(np.array, itertools.permutations(CUES)):
        before.append(follower.predict(CUES, deterministic=True)[0] == leader)
        watched = np.random.default_rng(0).integers(3, size=400)
        # The follower's own observations, and what the leader did at them
        follower.policy.remember(watched, {"leader": leader[watched]})
        after.append(follower.predict(CUES, deterministic=True)[0] == leader)
        believed = follower.policy.predict_others(CUES).actions["leader"].argmax(axis=1)
        print(f"A leader plays {leader} at the cues 0 1 2. After 400 steps of watching the follower expects {believed}.")
    rates = {"before": float(np.mean(before)), "after": float(np.mean(after))}
    print("Cues at which the follower plays what a new leader plays:", end=" ")
    print(f"{rates['before']:.0%} while it still expects the previous leader, {rates['after']:.0%} after watching.")
    return rates


if __name__ == "__main__":
    th.set_num_threads(1)
    main()
