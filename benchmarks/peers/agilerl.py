"""
AgileRL's IPPO, run by ``benchmarks.peers`` in an environment of its own.

The loop over steps is that of its documentation and of ``train_multi_agent_on_policy``, without scores, evaluation and
mutation. AgileRL's own vectorised environment runs every copy in a process (``--processes``). This workload is faster with
``Copies``, a plain loop over them in this process, which AgileRL does not have; both are measured. By default, agents whose
names differ only by a number share networks. Here each has its own, with two layers of 64 units (``Layer`` is needed because
AgileRL's own networks have at least three layers).

What differs: the policy and the value network each have an Adam and a clipped gradient of their own, and the value loss is
clipped, too. An end by the time limit counts as the end of the return, where the others bootstrap from the value network. The
import needs peft, which AgileRL does not list as a requirement.
"""

import argparse
from collections.abc import Mapping
from typing import Any

import numpy as np
from agilerl.algorithms import IPPO
from agilerl.modules import ModuleDict
from agilerl.modules.base import EvolvableModule
from agilerl.networks.actors import StochasticActor
from agilerl.networks.value_networks import ValueNetwork
from agilerl.vector import AsyncPettingZooVecEnv, PettingZooVecEnv
from mpe2 import simple_spread_v3
from torch import Tensor, nn

from benchmarks.peers.child import Turns, Workload, workload


class Layer(EvolvableModule):
    """
    First layer of a network, as its encoder; the head has the second layer.

    :param num_inputs: Width of an observation
    :param num_outputs: Width of the layer
    """

    def __init__(self, num_inputs: int, num_outputs: int) -> None:
        super().__init__(device="cpu")
        # AgileRL clones a module by reading its constructor's arguments from attributes
        self.num_inputs, self.num_outputs = num_inputs, num_outputs
        self.net = nn.Sequential(nn.Linear(num_inputs, num_outputs), nn.Tanh())

    @property
    def net_config(self) -> dict[str, Any]:
        return {}

    @property
    def activation(self) -> str:
        return "Tanh"

    def forward(self, x: Tensor) -> Tensor:
        return self.net(x)


class SeparateIPPO(IPPO):
    """IPPO in which agents with names like agent_0 and agent_1 are not put into one group."""

    def get_group_id(self, agent_id: str) -> str:
        return agent_id


class Copies(PettingZooVecEnv):
    """
    Vectorised environment that steps copies of simple_spread one after the other in this process.

    :param n_envs: Number of copies
    """

    def __init__(self, n_envs: int) -> None:
        self.envs = [simple_spread_v3.parallel_env() for _ in range(n_envs)]
        env = self.envs[0]
        agents = env.possible_agents
        spaces = ({agent: space(agent) for agent in agents} for space in (env.observation_space, env.action_space))
        super().__init__(n_envs, *spaces, agents)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        return self._stack([env.reset()[0] for env in self.envs]), {agent: {} for agent in self.agents}

    def step(self, actions: Mapping[str, Any], *args: Any, **kwargs: Any) -> tuple[dict, ...]:
        steps = []
        for i, env in enumerate(self.envs):
            obs, *rest = env.step({agent: int(actions[agent][i]) for agent in self.agents})
            steps.append((obs if env.agents else env.reset()[0], *rest))
        obs, rewards, terminations, truncations, _ = (self._stack(column) for column in zip(*steps, strict=True))
        return obs, rewards, terminations, truncations, {agent: {} for agent in self.agents}

    def _stack(self, columns: Any) -> dict[str, np.ndarray]:
        return {agent: np.array([column[agent] for column in columns]) for agent in self.agents}


def learners(env: PettingZooVecEnv, work: Workload) -> IPPO:
    """Return the three learners for the workload."""
    first, second = work.hidden
    actors, critics = ModuleDict(), ModuleDict()
    for agent in env.agents:
        obs_space, action_space = env.single_observation_space(agent), env.single_action_space(agent)
        # One dict each, since AgileRL changes the settings of a head in place
        heads = [{"hidden_size": [second], "activation": "Tanh", "layer_norm": False} for _ in range(2)]
        encoders = [Layer(obs_space.shape[0], first) for _ in range(2)]
        actors[agent] = StochasticActor(obs_space, action_space, encoder=encoders[0], head_config=heads[0])
        critics[agent] = ValueNetwork(obs_space, encoder=encoders[1], head_config=heads[1])
    return SeparateIPPO(
        [env.single_observation_space(agent) for agent in env.agents],
        [env.single_action_space(agent) for agent in env.agents],
        env.agents,
        actor_networks=actors,
        critic_networks=critics,
        batch_size=work.batch_size,
        learn_step=work.rows,
        update_epochs=work.n_epochs,
        lr=work.lr,
        gamma=work.gamma,
        gae_lambda=work.gae_lambda,
        clip_coef=work.clip,
        ent_coef=0.0,
        vf_coef=work.vf_coef,
        max_grad_norm=work.max_grad_norm,
    )


def main() -> None:
    """Train until there are no more requests."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--processes", action="store_true", help="AgileRL's own vectorised environment")
    work, args = workload(parser)
    turns = Turns("agilerl")
    env = AsyncPettingZooVecEnv([simple_spread_v3.parallel_env] * work.n_envs) if args.processes else Copies(work.n_envs)
    algorithm = learners(env, work)
    algorithm.set_training_mode(True)
    obs, info = env.reset()
    done = {agent: np.zeros(work.n_envs) for agent in env.agents}
    while True:
        # Observations, actions, log probabilities, rewards, dones and values of each agent
        rollout: tuple[dict[str, list], ...] = tuple({agent: [] for agent in env.agents} for _ in range(6))
        for _ in range(work.n_steps):
            action, log_prob, _, value = algorithm.get_action(obs, info)
            next_obs, reward, terminated, truncated, info = env.step(action)
            for column, now in zip(rollout, (obs, action, log_prob, reward, done, value), strict=True):
                for agent in env.agents:
                    column[agent].append(now[agent])
            obs = next_obs
            done = {agent: np.logical_or(terminated[agent], truncated[agent]).astype(float) for agent in env.agents}
        algorithm.learn((*rollout, obs, done))
        turns.end(work.rows)


if __name__ == "__main__":
    main()
