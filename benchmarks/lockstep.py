"""
What lockstep costs: a team of three stock PPOs against the same three trained by a hand-written loop.

Both train on mpe2's simple_spread (8 copies x 128 steps per iteration, 10 epochs, 4 minibatches, 64x64 tanh, one thread), in
turn within one run, and count joint steps (of one copy) per second of CPU time of this process.
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
    """The same three PPOs' policies, buffers and ``train()``, with the loop over steps written out for this environment."""

    def __init__(self) -> None:
        self.envs = [simple_spread_v3.parallel_env() for _ in range(N_ENVS)]
        self.agents = self.envs[0].possible_agents
        self.models = {}
        # Only for the models' spaces; it is never stepped
        hub = Lockstep(make_team_env(simple_spread_v3.parallel_env, n_envs=N_ENVS))
        for k, agent in enumerate(self.agents):
            model = PPO("MlpPolicy", hub.agent_envs[agent], seed=k, **SETTINGS)  # type: ignore[arg-type]
            model.set_logger(Logger(None, []))
            self.models[agent] = model
        observations = [env.reset(seed=i)[0] for i, env in enumerate(self.envs)]
        self.obs = {agent: np.stack([obs[agent] for obs in observations]) for agent in self.agents}
        self.starts = np.ones(N_ENVS, dtype=bool)
        self.episodes: dict[str, deque] = {agent: deque(maxlen=100) for agent in self.agents}
        self.returns = np.zeros((N_ENVS, len(self.agents)))

    def iterate(self, iterations: int) -> None:
        for _ in range(iterations):
            self._rollout()
            for model in self.models.values():
                model.logger.dump()
                model.train()

    def _rollout(self) -> None:
        for model in self.models.values():
            model.policy.set_training_mode(False)
            model.rollout_buffer.reset()
        for _ in range(N_STEPS):
            self._step()
        with th.no_grad():
            for agent, model in self.models.items():
                values = model.policy.predict_values(th.as_tensor(self.obs[agent]))
                model.rollout_buffer.compute_returns_and_advantage(values, self.starts)

    def _step(self) -> None:
        outputs = {}
        with th.no_grad():
            for agent, model in self.models.items():
                actions, values, log_probs = model.policy(th.as_tensor(self.obs[agent]))
                outputs[agent] = actions.numpy(), values, log_probs
        next_obs = {agent: np.empty_like(obs) for agent, obs in self.obs.items()}
        rewards = np.zeros((N_ENVS, len(self.agents)), dtype=np.float32)
        dones = np.zeros(N_ENVS, dtype=bool)
        for i, env in enumerate(self.envs):
            obs, reward, _, _, _ = env.step({agent: int(outputs[agent][0][i]) for agent in self.agents})
            rewards[i] = [reward[agent] for agent in self.agents]
            self.returns[i] += rewards[i]
            if not env.agents:
                # Every end of this environment is a time limit
                dones[i] = True
                with th.no_grad():
                    for k, (agent, model) in enumerate(self.models.items()):
                        value = model.policy.predict_values(th.as_tensor(obs[agent][None]))
                        rewards[i, k] += model.gamma * float(value)
                        self.episodes[agent].append(self.returns[i, k])
                self.returns[i] = 0.0
                obs, _ = env.reset()
            for agent in self.agents:
                next_obs[agent][i] = obs[agent]
        for k, (agent, model) in enumerate(self.models.items()):
            actions, values, log_probs = outputs[agent]
            model.rollout_buffer.add(self.obs[agent], actions.reshape(-1, 1), rewards[:, k], self.starts, values, log_probs)
            model.num_timesteps += N_ENVS
        self.obs, self.starts = next_obs, dones


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=25, help="measurements of each")
    parser.add_argument("--iterations", type=int, default=1, help="iterations of each measurement")
    args = parser.parse_args()
    th.set_num_threads(1)

    loops: dict[str, ByTeam | ByHand] = {"team": ByTeam(), "by hand": ByHand()}
    speeds: dict[str, list[float]] = {name: [] for name in loops}
    for loop in loops.values():
        loop.iterate(1)
    for _ in range(args.rounds):
        for name, loop in loops.items():
            start = time.process_time()
            loop.iterate(args.iterations)
            speeds[name].append(args.iterations * N_ENVS * N_STEPS / (time.process_time() - start))
    medians = {name: statistics.median(values) for name, values in speeds.items()}
    for name, values in speeds.items():
        print(f"{name:8s} {medians[name]:7.1f} joint steps per CPU second (from {min(values):.1f} to {max(values):.1f})")
    print(f"ratio    {medians['team'] / medians['by hand']:7.3f}")


if __name__ == "__main__":
    main()
