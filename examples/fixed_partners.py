"""
One agent learns in a plain Gymnasium environment in which a fixed partner acts for its teammate. It adapts to a new partner.

    python examples/fixed_partners.py
"""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from pettingzoo import ParallelEnv
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_belief import AgentEnv, BeliefPPO


class Greeting(ParallelEnv):
    """Two agents see the same one of three cues for eight steps and earn 1 at each step at which their actions are equal."""

    def __init__(self) -> None:
        self.possible_agents, self.rng = ["guest", "host"], np.random.default_rng()

    def observation_space(self, agent: str) -> spaces.Space:
        return spaces.Discrete(3)

    action_space = observation_space

    def reset(self, seed: int | None = None, options: dict | None = None) -> Any:
        if seed is not None:  # without a seed the generator continues
            self.rng = np.random.default_rng(seed)
        self.agents, self.time = list(self.possible_agents), 0
        return dict.fromkeys(self.agents, int(self.rng.integers(3))), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, int]) -> Any:
        acted, self.time = self.agents, self.time + 1
        over, reward = self.time == 8, float(actions["guest"] == actions["host"])
        self.agents = [] if over else acted
        observations, rewards = dict.fromkeys(acted, int(self.rng.integers(3))), dict.fromkeys(acted, reward)
        return observations, rewards, dict.fromkeys(acted, over), dict.fromkeys(acted, False), {agent: {} for agent in acted}


def same_cue(cue: int) -> int:
    """Answer a cue with its own number."""
    return cue


def next_cue(cue: int) -> int:
    """Answer a cue with the number after it."""
    return (cue + 1) % 3


def main(total_timesteps: int = 10_000) -> dict[str, Any]:
    """Train a guest with one host and then with another, and return the numbers that are printed."""
    # A partner is a callable, an SB3 model, or the path of its zip or of a whole team's
    kwargs = {"parallel_env": Greeting, "agent": "guest", "partners": {"host": same_cue}}
    env, eval_env = (make_vec_env(AgentEnv, n_envs=8, seed=seed, env_kwargs=kwargs) for seed in (0, 1000))
    guest = BeliefPPO("BeliefPolicy", env, seed=0, n_steps=64, batch_size=128, learning_rate=1e-3, gamma=0.0, ent_coef=0.01)

    guest.learn(total_timesteps // 2)
    known, _ = evaluate_policy(guest, eval_env, n_eval_episodes=100)
    for each in (env, eval_env):
        each.env_method("set_partner", "host", next_cue)
    new, _ = evaluate_policy(guest, eval_env, n_eval_episodes=100)
    guest.learn(total_timesteps // 2, reset_num_timesteps=False)
    adapted, _ = evaluate_policy(guest, eval_env, n_eval_episodes=100)
    print(f"Equal actions, of 8: {known:.1f} with the first host, {new:.1f} with a new one, {adapted:.1f} after adapting.")
    return {"known": known, "new": new, "adapted": adapted}


if __name__ == "__main__":
    th.set_num_threads(1)
    main()
