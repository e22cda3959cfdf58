"""
Each agent of a team has an algorithm of its own. An agent is an ordinary SB3 model, so any combination of them works.

    python examples/mixed_algorithms.py
"""

from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_belief import BeliefPPO, Team, make_team_env

ALGORITHMS: dict[str, Any] = {"car_0": BeliefPPO, "car_1": PPO, "car_2": PPO, "car_3": A2C, "car_4": DQN}
POLICIES = {agent: "BeliefPolicy" if algorithm is BeliefPPO else "MlpPolicy" for agent, algorithm in ALGORITHMS.items()}
PPO_KWARGS = {"n_steps": 40, "batch_size": 640, "n_epochs": 4, "learning_rate": 1e-3}
AGENT_KWARGS: dict[str, dict[str, Any]] = {
    "car_0": {**PPO_KWARGS, "history_length": 400},
    "car_1": PPO_KWARGS,
    "car_2": PPO_KWARGS,
    "car_3": {"n_steps": 10},
    "car_4": {"learning_rate": 1e-3, "train_freq": 1, "target_update_interval": 500, "exploration_final_eps": 0.02},
}


def returns(team: Any) -> np.ndarray:
    """Return each agent's mean return over 256 episodes that training does not see."""
    env = make_team_env("traffic-junction-easy", n_envs=32, seed=1000)
    rewards: list[np.ndarray] = []
    evaluate_policy(team, env, n_eval_episodes=256, callback=lambda step, _: rewards.append(step["info"]["agent_rewards"]))
    return np.sum(rewards, axis=0) / 256


def main(total_timesteps: int = 30_000) -> dict[str, tuple[float, float]]:
    """Train and evaluate a team, and return the numbers that are printed: each agent's return before and after."""
    env = make_team_env("traffic-junction-easy", n_envs=32, seed=0, env_kwargs={"reward_scale": 0.1})
    # Arguments outside agent_kwargs are those of all agents
    team = Team(ALGORITHMS, POLICIES, env, seed=0, agent_kwargs=AGENT_KWARGS, gamma=0.9)
    before, after = returns(team), returns(team.learn(total_timesteps))
    numbers = dict(zip(team.possible_agents, zip(before, after, strict=True), strict=True))
    for agent, (first, last) in numbers.items():
        print(f"{agent} {ALGORITHMS[agent].__name__:9s}  return {first:6.2f} before training, {last:6.2f} after")
    return numbers


if __name__ == "__main__":
    th.set_num_threads(1)
    main()
