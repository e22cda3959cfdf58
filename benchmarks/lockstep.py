"""
What lockstep costs: a team of three stock PPOs against the same three trained by a hand-written loop.

All train on mpe2's simple_spread (8 copies x 128 steps per iteration, 10 epochs, 4 minibatches, 64x64 tanh, one thread), in
turn within one run, and count joint steps (of one copy) per second of CPU time of this process. Two loops are compared with:

- ``by hand``: over the same vectorised environment as the team's; what lockstep and SB3's own rollout cost
- ``bare``: over eight bare environments of just this kind (all agents always in play, one action type, every end a time limit,
  no visibility, no infos); what a team costs altogether against a program for one environment only
"""

import argparse
import statistics
import time
from collections import deque

import numpy as np
import torch as th
from mpe2 import simple_spread_v3
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger

from sb3_belief.team import Team, make_team_env
from sb3_belief.team.lockstep import Lockstep

Advance = tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, dict[int, dict[str, np.ndarray]]]

N_ENVS, N_STEPS = 8, 128
SETTINGS = dict(n_steps=N_STEPS, batch_size=N_ENVS * N_STEPS // 4, n_epochs=10, device="cpu")


class ByTeam:
    """Three PPOs in a ``Team``."""

    def __init__(self) -> None:
        env = make_team_env(simple_spread_v3.parallel_env, n_envs=N_ENVS)
        self.team = Team(PPO, "MlpPolicy", env, seed=0, **SETTINGS)  # type: ignore[arg-type]

    def iterate(self, iterations: int) -> None:
        self.team.learn(iterations * N_ENVS * N_STEPS, reset_num_timesteps=False)


class ByHand:
    """The same three PPOs' policies, buffers and ``train()``, with the loop over steps written out."""

    def __init__(self) -> None:
        self.env = make_team_env(simple_spread_v3.parallel_env, n_envs=N_ENVS, seed=0)
        self.agents = self.env.possible_agents
        # Only for the models' spaces; it is never stepped
        hub = Lockstep(make_team_env(simple_spread_v3.parallel_env, n_envs=N_ENVS))
        self.models = {}
        for k, agent in enumerate(self.agents):
            model = PPO("MlpPolicy", hub.agent_envs[agent], seed=k, **SETTINGS)  # type: ignore[arg-type]
            model.set_logger(Logger(None, []))
            self.models[agent] = model
        self.obs = self._reset()
        self.starts = np.ones(N_ENVS, dtype=bool)

    def iterate(self, iterations: int) -> None:
        for _ in range(iterations):
            for model in self.models.values():
                model.policy.set_training_mode(False)
                model.rollout_buffer.reset()
            for _ in range(N_STEPS):
                self._step()
            for agent, model in self.models.items():
                with th.no_grad():
                    values = model.policy.predict_values(th.as_tensor(self.obs[agent]))
                model.rollout_buffer.compute_returns_and_advantage(values, self.starts)
                model.logger.dump()
                model.train()

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
            model.num_timesteps += N_ENVS
        self.obs, self.starts = next_obs, dones

    def _reset(self) -> dict[str, np.ndarray]:
        return self.env.reset()

    def _advance(self, actions: dict[str, np.ndarray]) -> Advance:
        """
        :return: next observations, rewards [n_envs, n], dones [n_envs] and of ended copies the last observations
        """
        obs, _, dones, infos = self.env.step(actions)
        rewards = np.array([info["agent_rewards"] for info in infos])
        return obs, rewards, dones, {i: infos[i]["terminal_observation"] for i in np.flatnonzero(dones).tolist()}


class Bare(ByHand):
    """The same loop over bare environments."""

    def _reset(self) -> dict[str, np.ndarray]:
        self.envs = [simple_spread_v3.parallel_env() for _ in range(N_ENVS)]
        self.episodes: deque = deque(maxlen=100)
        self.returns = np.zeros((N_ENVS, len(self.agents)))
        observations = [env.reset(seed=i)[0] for i, env in enumerate(self.envs)]
        return {agent: np.stack([obs[agent] for obs in observations]) for agent in self.agents}

    def _advance(self, actions: dict[str, np.ndarray]) -> Advance:
        next_obs = {agent: np.empty_like(obs) for agent, obs in self.obs.items()}
        rewards = np.zeros((N_ENVS, len(self.agents)), dtype=np.float32)
        dones = np.zeros(N_ENVS, dtype=bool)
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


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=25, help="measurements of each")
    parser.add_argument("--iterations", type=int, default=1, help="iterations of each measurement")
    args = parser.parse_args()
    th.set_num_threads(1)

    loops: dict[str, ByTeam | ByHand] = {"team": ByTeam(), "by hand": ByHand(), "bare": Bare()}
    speeds: dict[str, list[float]] = {name: [] for name in loops}
    for loop in loops.values():
        loop.iterate(1)
    for _ in range(args.rounds):
        for name, loop in loops.items():
            start = time.process_time()
            loop.iterate(args.iterations)
            speeds[name].append(args.iterations * N_ENVS * N_STEPS / (time.process_time() - start))
    for name, values in speeds.items():
        median = statistics.median(values)
        print(f"{name:8s} {median:7.1f} joint steps per CPU second (from {min(values):.1f} to {max(values):.1f})")
    for name in ("by hand", "bare"):
        # Round by round: what the machine does besides changes more slowly than the loops take turns
        ratios = sorted(team / loop for team, loop in zip(speeds["team"], speeds[name], strict=True))
        low, median, high = ratios[len(ratios) // 4], statistics.median(ratios), ratios[-1 - len(ratios) // 4]
        print(f"team / {name:8s} median {median:.3f} (middle half from {low:.3f} to {high:.3f})")


if __name__ == "__main__":
    main()
