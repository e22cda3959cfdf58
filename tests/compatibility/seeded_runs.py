"""
Seeded runs whose results must not change: ``python -m tests.compatibility.seeded_runs FILE`` records them.

Those in ``data/seeded_runs.json`` were recorded with the version before the package was rearranged.
"""

import json
import sys
from collections.abc import Callable
from typing import Any

import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

from sb3_belief import AgentEnv, BeliefPPO, MaskableBeliefPPO, Team, make_team_env

ENV_ID = "traffic-junction-easy"
PPO_KWARGS: dict[str, Any] = {"n_steps": 32, "batch_size": 24, "n_epochs": 2, "seed": 3}
BELIEF: dict[str, Any] = {"history_length": 60, "keep_ratio": 0.2}
KINDS: dict[str, tuple[Any, str, dict[str, Any]]] = {
    "ppo": (PPO, "MlpPolicy", {}),
    "dynamic": (BeliefPPO, "BeliefPolicy", BELIEF),
    "none": (BeliefPPO, "BeliefPolicy", {"belief": "none"}),
    "maskable": (MaskableBeliefPPO, "BeliefPolicy", BELIEF),
}


def first_possible(obs: Any, action_masks: Any = None) -> int:
    """A partner that takes the first action that is possible."""
    return 0 if action_masks is None or action_masks[0] else 1


def summary(model: Any) -> list[float]:
    """The sum and the norm of all parameters."""
    vector = th.nn.utils.parameters_to_vector(model.policy.parameters()).detach().double()
    return [vector.sum().item(), vector.norm().item()]


def alone(kind: str) -> dict[str, list[float]]:
    """One learner among fixed partners."""
    algorithm, policy, kwargs = KINDS[kind]
    partners = {f"car_{i}": first_possible for i in range(1, 5)}
    env_kwargs = {"parallel_env": ENV_ID, "agent": "car_0", "partners": partners, "env_kwargs": {"reward_scale": 0.1}}
    env = make_vec_env(AgentEnv, n_envs=3, seed=0, env_kwargs=env_kwargs)
    return {"car_0": summary(algorithm(policy, env, **PPO_KWARGS, **kwargs).learn(3 * 32 * 3))}


def team(kind: str, jobs: int = 1) -> dict[str, list[float]]:
    """Five learners, in one or several processes."""
    algorithm, policy, kwargs = KINDS[kind]
    env = make_team_env(ENV_ID, n_envs=3, seed=0)
    learners = Team(algorithm, policy, env, jobs=jobs, **PPO_KWARGS, **kwargs).learn(3 * 32 * 2)
    return {agent: summary(model) for agent, model in learners.agents.items()}


RUNS: dict[str, Callable[[], dict[str, list[float]]]] = {
    **{f"{kind} alone": lambda kind=kind: alone(kind) for kind in KINDS},  # type: ignore[misc]
    **{f"{kind} in a team": lambda kind=kind: team(kind) for kind in KINDS},  # type: ignore[misc]
    "dynamic in a team with 2 jobs": lambda: team("dynamic", jobs=2),
}

if __name__ == "__main__":
    th.set_num_threads(1)
    with open(sys.argv[1], "w") as file:
        json.dump({name: run() for name, run in RUNS.items()}, file, indent=1)
