"""Teams in which something goes wrong once, and all that their models hold."""

from functools import partial
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import A2C, DQN, PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback

from sb3_belief import BeliefPPO
from tests.team.helpers import PPO_KWARGS, Team, make_team_env
from tests.team.toy_envs import ToyEnv

OFF_POLICY: dict[str, Any] = dict(
    learning_starts=10, buffer_size=200, batch_size=8, device="cpu", policy_kwargs={"net_arch": [8]}
)
KWARGS: dict[type, dict[str, Any]] = {
    PPO: PPO_KWARGS,
    A2C: {"n_steps": 8, "device": "cpu", "policy_kwargs": {"net_arch": [8]}},
    BeliefPPO: {"n_steps": 8, "batch_size": 8, "n_epochs": 2, "device": "cpu", "history_length": 20},
    DQN: {**OFF_POLICY, "train_freq": 1},
    SAC: OFF_POLICY,
}
ALGORITHMS = [PPO, A2C, BeliefPPO, DQN, SAC]


class OddEnv(ToyEnv):
    """
    ``ToyEnv`` in which ``agent_1`` is given something odd once, at a step counted over all episodes.

    :param at: Number of the step, from 1; 0 for never
    :param reward: Its reward then
    :param observation: What it observes then
    :param box: Whether actions are continuous
    """

    def __init__(self, at: int = 0, reward: float = 0.0, observation: float = 0.0, box: bool = False):
        super().__init__()
        self.at, self.reward, self.observation, self.box, self.steps = at, reward, observation, box, 0

    def action_space(self, agent):
        return spaces.Box(-1.0, 1.0, (1,), np.float32) if self.box else super().action_space(agent)

    def step(self, actions):
        self.steps += 1
        if self.box:
            actions = {agent: 1 + round(float(action[0])) for agent, action in actions.items()}
        obs, rewards, *rest = super().step(actions)
        if self.steps == self.at:
            rewards["agent_1"] += self.reward
            obs["agent_1"] = obs["agent_1"] + np.float32(self.observation)
        return obs, rewards, *rest


def make_team(algo=PPO, on_nan="raise", env_kwargs=None, n_envs=1, **kwargs):
    """Return a team of two agents in an ``OddEnv``."""
    env = make_team_env(partial(OddEnv, box=algo is SAC, **(env_kwargs or {})), n_envs=n_envs)
    policy = "BeliefPolicy" if algo is BeliefPPO else "MlpPolicy"
    return Team(algo, policy, env, seed=0, on_nan=on_nan, **{**KWARGS[algo], **kwargs})


def contents(model):
    """Copies of all tensors of a model and its optimizers, by name."""
    found = {}
    for name, part in model.get_parameters().items():
        if isinstance(part, th.Tensor):
            found[name] = part.detach().clone()
        elif "state" in part and "param_groups" in part:
            for i, state in part["state"].items():
                found |= {f"{name} {i} {key}": th.as_tensor(value).clone() for key, value in state.items()}
        else:
            found |= {f"{name} {key}": value.detach().clone() for key, value in part.items()}
    return found


def same(one, other):
    """Whether two such contents are equal to the bit."""
    return one.keys() == other.keys() and all(th.equal(one[name], other[name]) for name in one)


def is_finite(model):
    return all(bool(th.isfinite(value).all()) for value in contents(model).values())


class Watch(BaseCallback):
    """Callback of an agent that keeps what its model holds at the end of each rollout, and at the beginning of each."""

    def __init__(self):
        super().__init__()
        self.ends: list[dict] = []
        self.starts: list[dict] = []

    def _on_step(self):
        return True

    def _on_rollout_start(self):
        assert "train" not in vars(self.model)
        self.starts.append(contents(self.model))

    def _on_rollout_end(self):
        assert "train" not in vars(self.model)
        self.ends.append(contents(self.model))

    def _on_training_end(self):
        assert "train" not in vars(self.model)


def spoil(model, at_step, value=float("nan")):
    """Have the optimizer's n-th step leave a value in a weight of the first layer."""
    optimizer = model.policy.optimizer if not isinstance(model, SAC) else model.actor.optimizer
    weight = optimizer.param_groups[0]["params"][-1 if isinstance(model, SAC) else 0]
    steps = []

    def hook(*_):
        steps.append(1)
        if len(steps) == at_step:
            with th.no_grad():
                weight.view(-1)[0] = value

    optimizer.register_step_post_hook(hook)
