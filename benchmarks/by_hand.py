"""
Three stock PPOs that learn on mpe2's simple_spread in a hand-written program: what a team is compared with.

- ``ByHand`` is what one would write for this environment only: it steps copies of mpe2's own parallel environment (all agents
  always in play, one kind of action, every end a time limit, no visibility, no infos)
- ``ByHandOnTeamEnv`` steps the same vectorised environment as the team, so that the difference to the team is the cost of
  lockstep and of SB3's own rollout
"""

from collections import deque
from typing import Any

import numpy as np
import torch as th
from mpe2 import simple_spread_v3
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger

from benchmarks.teams import SPREAD
from sb3_belief import Team, make_team_env

Advance = tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, dict[int, dict[str, np.ndarray]]]


class ByHandOnTeamEnv:
    """
    Loop over steps, written out, around the policies, buffers and ``train()`` of three stock PPOs.

    :param n_envs: Number of copies
    :param settings: Arguments of PPO
    """

    def __init__(self, n_envs: int, settings: dict[str, Any]) -> None:
        self.n_envs = n_envs
        self.env = make_team_env(SPREAD, n_envs=n_envs, seed=0)
        self.agents = self.env.possible_agents
        # A convenient way to make the models; this team never learns, nor is its environment stepped
        team = Team(PPO, "MlpPolicy", make_team_env(SPREAD, n_envs=n_envs), seed=0, device="cpu", **settings)
        self.models: dict[str, PPO] = team.agents  # type: ignore[assignment]
        for model in self.models.values():
            model.set_logger(Logger(None, []))
        self.obs = self._reset()
        self.starts = np.ones(self.n_envs, dtype=bool)

    def __call__(self) -> int:
        """Collect one rollout, update all models, and return the number of joint steps."""
        n_steps = next(iter(self.models.values())).n_steps
        for model in self.models.values():
            model.policy.set_training_mode(False)
            model.rollout_buffer.reset()
        for _ in range(n_steps):
            self._step()
        for agent, model in self.models.items():
            with th.no_grad():
                values = model.policy.predict_values(th.as_tensor(self.obs[agent]))
            model.rollout_buffer.compute_returns_and_advantage(values, self.starts)
            model.logger.dump()
            model.train()
        return n_steps * self.n_envs

    def _step(self) -> None:
        outputs, actions = {}, {}
        with th.no_grad():
            for agent, model in self.models.items():
                outputs[agent] = model.policy(th.as_tensor(self.obs[agent]))
                actions[agent] = outputs[agent][0].numpy()
        next_obs, rewards, dones, terminal_obs = self._advance(actions)
        for i in np.flatnonzero(dones).tolist():
            for k, (agent, model) in enumerate(self.models.items()):
                with th.no_grad():
                    value = model.policy.predict_values(th.as_tensor(terminal_obs[i][agent][None]))
                rewards[i, k] += model.gamma * float(value)
        for k, (agent, model) in enumerate(self.models.items()):
            _, values, log_probs = outputs[agent]
            chosen = actions[agent].reshape(-1, 1)
            model.rollout_buffer.add(self.obs[agent], chosen, rewards[:, k], self.starts, values, log_probs)
            model.num_timesteps += self.n_envs
        self.obs, self.starts = next_obs, dones

    def _reset(self) -> dict[str, np.ndarray]:
        return self.env.reset()

    def _advance(self, actions: dict[str, np.ndarray]) -> Advance:
        """Return next observations, rewards [n_envs, n], dones [n_envs], and the last observations of copies that ended."""
        obs, _, dones, infos = self.env.step(actions)
        rewards = np.array([info["agent_rewards"] for info in infos])
        return obs, rewards, dones, {i: infos[i]["terminal_observation"] for i in np.flatnonzero(dones).tolist()}


class ByHand(ByHandOnTeamEnv):
    """The same loop over mpe2's environments as they are."""

    def _reset(self) -> dict[str, np.ndarray]:
        self.envs = [simple_spread_v3.parallel_env() for _ in range(self.n_envs)]
        self.episodes: deque = deque(maxlen=100)
        self.returns = np.zeros((self.n_envs, len(self.agents)))
        observations = [env.reset(seed=i)[0] for i, env in enumerate(self.envs)]
        return {agent: np.stack([obs[agent] for obs in observations]) for agent in self.agents}

    def _advance(self, actions: dict[str, np.ndarray]) -> Advance:
        next_obs = {agent: np.empty_like(obs) for agent, obs in self.obs.items()}
        rewards = np.zeros((self.n_envs, len(self.agents)), dtype=np.float32)
        dones = np.zeros(self.n_envs, dtype=bool)
        terminal_obs = {}
        for i, env in enumerate(self.envs):
            obs, reward, _, _, _ = env.step({agent: int(actions[agent][i]) for agent in self.agents})
            rewards[i] = [reward[agent] for agent in self.agents]
            self.returns[i] += rewards[i]
            if not env.agents:
                dones[i], terminal_obs[i] = True, obs
                self.episodes.append(self.returns[i].copy())
                self.returns[i] = 0.0
                obs, _ = env.reset()
            for agent in self.agents:
                next_obs[agent][i] = obs[agent]
        return next_obs, rewards, dones, terminal_obs
