"""
The settings with which ``benchmarks.strength`` trains on simple_spread, the same for both libraries where both have them.

This needs nothing but the standard library, since the environment of the other library reads it, too.
"""

import argparse
import json
import time
from dataclasses import dataclass

ON_POLICY = ("ippo", "ippo_shared", "mappo")
OFF_POLICY = ("qmix", "maddpg")
GAMMA = 0.95
HIDDEN = (64, 64)
MAX_GRAD_NORM = 10.0
#: Steps of an episode
LENGTH = 25


@dataclass(frozen=True)
class OnPolicy:
    """Of the PPO family: 32 copies x one episode, ten passes in four minibatches."""

    n_envs: int = 32
    n_steps: int = LENGTH
    n_epochs: int = 10
    batch_size: int = 200
    lr: float = 7e-4
    gae_lambda: float = 0.95
    clip: float = 0.2
    ent_coef: float = 0.01


@dataclass(frozen=True)
class OffPolicy:
    """Of QMIX and MADDPG: 8 copies x one episode, then 8 updates; epsilon falls from 1 to .05 over half of the training."""

    n_envs: int = 8
    rows: int = 8 * LENGTH
    updates: int = 8
    batch_size: int = 1024
    lr: float = 1e-3
    final_eps: float = 0.05


def vf_coef(algorithm: str) -> float:
    """Return the weight of the values' loss, which for MAPPO is Huber's."""
    return 1.0 if algorithm == "mappo" else 0.5


def is_continuous(algorithm: str) -> bool:
    """Return whether the actions are velocities: BenchMARL's MADDPG takes no others."""
    return algorithm == "maddpg"


def arguments(description: str | None) -> argparse.Namespace:
    """Return the arguments of a program that trains one algorithm with one seed, and plays."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("algorithm", choices=(*ON_POLICY, *OFF_POLICY))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--episodes", type=int, default=320)
    return parser.parse_args()


def print_answer(returns: list[float]) -> None:
    """Print the returns of the episodes and the CPU seconds so far, as ``benchmarks.strength`` reads them."""
    print(json.dumps({"returns": returns, "seconds": time.process_time()}))
