"""
Not every action is possible at any time: MaskableBeliefPPO learns and is evaluated with the masks of the environment.

    python examples/action_masks.py
"""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from pettingzoo import ParallelEnv
from sb3_contrib.common.maskable.evaluation import evaluate_policy

from sb3_belief import MaskableBeliefPPO, Team, make_team_env


class Jobs(ParallelEnv):
    """Two workers choose among the open jobs, at first four of six. They earn 1 whenever they choose different ones."""

    def __init__(self) -> None:
        self.possible_agents, self.rng = ["ada", "bob"], np.random.default_rng()

    def observation_space(self, agent: str) -> spaces.Space:
        return spaces.MultiBinary(6)

    def action_space(self, agent: str) -> spaces.Space:
        return spaces.Discrete(6)

    def reset(self, seed: int | None = None, options: dict | None = None) -> Any:
        if seed is not None:  # without a seed the generator continues
            self.rng = np.random.default_rng(seed)
        self.agents, self.open = list(self.possible_agents), self.rng.permutation(6) < 4
        return self.observations_and_infos(self.agents)

    def step(self, actions: dict[str, int]) -> Any:
        chosen, acted = list(actions.values()), self.agents
        if not self.open[chosen].all():
            raise ValueError(f"A job is done already: {actions}")
        self.open[chosen] = False
        over, reward = bool(self.open.sum() < 2), float(chosen[0] != chosen[1])
        self.agents = [] if over else acted
        observations, infos = self.observations_and_infos(acted)
        return observations, dict.fromkeys(acted, reward), dict.fromkeys(acted, over), dict.fromkeys(acted, False), infos

    def observations_and_infos(self, agents: list[str]) -> Any:
        infos = {agent: {"action_mask": self.open.copy()} for agent in agents}
        return dict.fromkeys(agents, self.open.astype(np.int8)), infos


def main(total_timesteps: int = 16_000) -> dict[str, Any]:
    """Train and evaluate a team, and return the numbers that are printed."""
    env, eval_env = make_team_env(Jobs, n_envs=16, seed=0), make_team_env(Jobs, n_envs=8, seed=1000)
    kwargs: dict[str, Any] = {"n_steps": 32, "batch_size": 256, "n_epochs": 5, "learning_rate": 1e-3}
    team: Any = Team(MaskableBeliefPPO, "BeliefPolicy", env, seed=0, **kwargs)
    # sb3-contrib's evaluation passes the masks on. Its MaskableEvalCallback takes a team, too
    before, _ = evaluate_policy(team, eval_env, n_eval_episodes=200)
    team.learn(total_timesteps)
    after, _ = evaluate_policy(team, eval_env, n_eval_episodes=200)
    print(f"Different jobs in an episode: chosen {before:.2f} times before training, {after:.2f} times after.")
    return {"before": before, "after": after}


if __name__ == "__main__":
    th.set_num_threads(1)
    main()
