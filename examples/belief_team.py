"""
A team of BeliefPPO agents learns to cross a junction, and one of them shows how good its belief about the others is.

    python examples/belief_team.py
"""

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_belief import BeliefPPO, Team, make_team_env

TRAFFIC = {"reward_scale": 0.1}


def success_rate(team: Any) -> float:
    """Return the share of episodes without a collision, of 256 that training does not see. Without braking it is 1/4."""
    env = make_team_env("traffic-junction-easy", n_envs=32, seed=1000, env_kwargs=TRAFFIC)
    successes = []

    def record(step: dict, _: dict) -> None:
        if step["done"]:
            successes.append(step["info"]["is_success"])

    evaluate_policy(team, env, n_eval_episodes=256, callback=record)
    return float(np.mean(successes))


def main(total_timesteps: int = 40_000) -> dict[str, float]:
    """Train and evaluate a team, and return the numbers that are printed."""
    env = make_team_env("traffic-junction-easy", n_envs=32, seed=0, env_kwargs=TRAFFIC)
    # An episode has 20 steps. A small gamma suits the task, in which a collision follows its cause within a few steps
    team = Team(BeliefPPO, "BeliefPolicy", env, seed=0, n_steps=40, batch_size=640, n_epochs=4, learning_rate=1e-3, gamma=0.9)

    before = success_rate(team)
    after = success_rate(team.learn(total_timesteps))
    print(f"Episodes without a collision: {before:.0%} before training, {after:.0%} after.")

    # What the last update measured, on steps that the belief had not been trained on yet
    measured = team.agents["car_0"].logger.name_to_value
    accuracy, base_rate, gain = (float(measured[f"belief/{name}"]) for name in ("accuracy", "base_rate", "history_gain"))
    print(
        f"car_0 predicts {accuracy:.0%} of its teammates' visible actions. Naming the most frequent one gets {base_rate:.0%}."
    )
    print(f"Its prediction error grows by {gain:.3f} if the actions in its history are shuffled.")
    return {"before": before, "after": after, "accuracy": accuracy, "base_rate": base_rate, "history_gain": gain}


if __name__ == "__main__":
    th.set_num_threads(1)
    main()
