"""
The multi-particle environments of ``mpe2`` (``mpe/simple_spread_v3``), with a radius of sight if asked for.

Rewards are as the environment gives them, own for each agent; ``simple_spread`` mixes a common one in by ``local_ratio``. An
episode ends by truncation, at ``max_cycles``.
"""

from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np
from pettingzoo import ParallelEnv
from pettingzoo.utils.conversions import aec_to_parallel_wrapper

from sb3_belief.envs.adapters.pettingzoo import Adapter, versioned_modules
from sb3_belief.envs.suites import unknown_name


def names() -> list[str]:
    """
    :return: what comes after ``mpe/``
    """
    return versioned_modules("mpe2", root="mpe2")


def make(name: str, radius: float | None = None, **env_kwargs: Any) -> ParallelEnv:
    """
    Everything is visible in most of these tasks, so by default everybody sees everybody's actions. With ``radius`` an agent
    sees only teammates at most so far away: whoever is beyond is blanked in its observation (zeros, as mpe2 itself pads those
    that an agent does not see) and so are the actions it is told of. Landmarks stay visible.

    :param name: e.g. ``"simple_spread_v3"``
    :param radius: of sight, > 0, in the units of the positions (most tasks begin within [-1, 1] x [-1, 1]). None: no limit
    :param env_kwargs: keyword arguments of the environment. With its own ``num_agent_neighbors`` an agent is told the actions
        of those nearest ones that it observes.
    :return: the parallel environment; by itself it does not look whether actions are within their spaces
    :raises ValueError: for an unknown name, a radius that is not positive, or one for a task whose observations cannot be
        blanked
    """
    known = names()
    if name not in known:
        raise unknown_name("mpe", name, known)
    neighbors = env_kwargs.get("num_agent_neighbors")
    if radius is not None:
        if not radius > 0:
            raise ValueError(f"radius={radius!r} must be greater than 0, or None for no limit.")
        if name not in LAYOUTS:
            reason = _REASONS.get(name, "where its observations show teammates is not known")
            raise ValueError(
                f"'mpe/{name}' cannot have a radius: {reason}. Tasks that can: {', '.join(LAYOUTS)}. For this one, blank the"
                " observations in a wrapper of your own that has a method visibility() too."
            )
        if neighbors is not None:
            raise ValueError("radius and num_agent_neighbors are two limits of sight: choose one of them.")
    module = import_module(f"mpe2.{name}")
    if env_kwargs.get("continuous_actions", False):
        env: ParallelEnv = module.parallel_env(**env_kwargs)
    else:
        # Without mpe2's wrappers that refuse wrong actions and calls in the wrong order, as a TeamVecEnv does itself
        env = AllAtOnce(module.raw_env(**env_kwargs))
    if radius is not None:
        return WithinRadius(env, radius, LAYOUTS[name])
    return env if neighbors is None else AmongNearest(env, neighbors)


class AllAtOnce(aec_to_parallel_wrapper):
    """
    PettingZoo's conversion, less what it asks for and throws away (all observations, before each step): with mpe2's wrappers
    left out too, a step takes half the time. In mpe2 the last of the agents moves the world, and all end together.
    """

    def step(self, actions: dict[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        """
        :param actions: by agent
        :return: observations, rewards, terminations, truncations and infos, by agent
        """
        env, agents = self.aec_env, self.aec_env.agents[:]
        for agent in agents:
            env.step(actions[agent])
        observations = {agent: env.observe(agent) for agent in agents}
        result = observations, dict(env.rewards), dict(env.terminations), dict(env.truncations), dict(env.infos)
        while env.agents and (env.terminations[env.agent_selection] or env.truncations[env.agent_selection]):
            env.step(None)
        self.agents = env.agents
        return result


# Where an agent's observation shows its teammates. The first argument is the world's agents, the second the viewer's number;
# the result has the columns of each of its others, in order.
Columns = list[list[int]]


def _runs(*parts: tuple[int, int], n_others: int) -> Columns:
    """
    :param parts: (start, width) of blocks with ``width`` columns for each of the others in turn
    :param n_others: number of others
    :return: the columns of each of them
    """
    return [[start + k * width + c for start, width in parts for c in range(width)] for k in range(n_others)]


def _spread(world: Any, viewer: int) -> Columns:
    # own velocity 2, own position 2, landmarks 2 each | others' positions 2 each | others' messages 2 each
    n_others, start = len(world.agents) - 1, 4 + 2 * len(world.landmarks)
    return _runs((start, 2), (start + 2 * n_others, world.dim_c), n_others=n_others)


def _reference(world: Any, viewer: int) -> Columns:
    # own velocity 2, landmarks 2 each, goal's colour 3 | the other's message
    return _runs((2 + 2 * len(world.landmarks) + 3, world.dim_c), n_others=len(world.agents) - 1)


def _speaker_listener(world: Any, viewer: int) -> Columns:
    # speaker: goal's colour. Listener: own velocity 2, landmarks 2 each | the speaker's message
    return [[]] if viewer == 0 else _runs((2 + 2 * len(world.landmarks), world.dim_c), n_others=1)


def _adversary(world: Any, viewer: int) -> Columns:
    # (the good agents: goal's position 2), landmarks 2 each | others' positions 2 each
    start = 2 * len(world.landmarks) + (0 if world.agents[viewer].adversary else 2)
    return _runs((start, 2), n_others=len(world.agents) - 1)


def _push(world: Any, viewer: int) -> Columns:
    # adversary: own velocity 2, landmarks 2 each | others' positions. Good agent: own velocity 2, goal's position 2, own
    # colour 3, landmarks 2 each, their colours 3 each | others' positions
    n_landmarks = len(world.landmarks)
    start = 2 + 2 * n_landmarks if world.agents[viewer].adversary else 7 + 5 * n_landmarks
    return _runs((start, 2), n_others=len(world.agents) - 1)


def _tag(world: Any, viewer: int) -> Columns:
    # own velocity 2, own position 2, landmarks 2 each | others' positions 2 each | the good others' velocities 2 each
    others = [agent for i, agent in enumerate(world.agents) if i != viewer]
    start = 4 + 2 * sum(not landmark.boundary for landmark in world.landmarks)
    columns = _runs((start, 2), n_others=len(others))
    velocity = start + 2 * len(others)
    for k, other in enumerate(others):
        if not other.adversary:
            columns[k] += [velocity, velocity + 1]
            velocity += 2
    return columns


def _nobody(world: Any, viewer: int) -> Columns:
    # no teammate is in the observation
    return [[] for _ in world.agents[1:]]


#: The tasks that can have a radius
LAYOUTS: dict[str, Callable[[Any, int], Columns]] = {
    "simple_adversary_v3": _adversary,
    "simple_formation_v1": _nobody,
    "simple_line_v1": _nobody,
    "simple_push_v3": _push,
    "simple_reference_v3": _reference,
    "simple_speaker_listener_v4": _speaker_listener,
    "simple_spread_v3": _spread,
    "simple_tag_v3": _tag,
}
_REASONS = {
    "simple_v3": "it has one agent only",
    "simple_crypto_v3": "positions mean nothing in it",
    "simple_world_comm_v3": "its forests hide agents already, and observations tell of those in them",
    "collect_treasure_v1": "it shows teammates in the order of their distance",
}


class WithinRadius(Adapter):
    """
    Agents see their teammates up to a distance.

    :param env: the environment of mpe2
    :param radius: the distance
    :param layout: where observations show teammates
    """

    def __init__(self, env: ParallelEnv, radius: float, layout: Callable[[Any, int], Columns]):
        super().__init__(env)
        self.radius = radius
        self._world: Any = env.unwrapped.world
        # [n, n_others, width]: the columns that show an other, by viewer; viewers' observations differ in width
        self._shows = []
        for i, agent in enumerate(self.possible_agents):
            shows = np.zeros((len(self.possible_agents) - 1, *(env.observation_space(agent).shape or ())), dtype=bool)
            for k, columns in enumerate(layout(self._world, i)):
                shows[k, columns] = True
            self._shows.append(shows)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """
        :param seed: of the environment, None: its generator goes on
        :param options: handed to the environment
        :return: observations and infos, by agent
        """
        obs, infos = self.env.reset(seed=seed, options=options)
        return self._blank(obs), infos

    def step(self, actions: dict[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        """
        :param actions: by agent
        :return: observations, rewards, terminations, truncations and infos, by agent
        """
        obs, rewards, terminations, truncations, infos = self.env.step(actions)
        return self._blank(obs), rewards, terminations, truncations, infos

    def visibility(self) -> dict[str, np.ndarray]:
        """
        :return: bool [n_others] by agent: who is within the radius after the last step, as the observation shows it
        """
        within = distances(self._world) <= self.radius
        return {agent: np.delete(within[i], i) for i, agent in enumerate(self.possible_agents)}

    def _blank(self, obs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        visible = self.visibility()
        return {
            agent: np.where(shows[~visible[agent]].any(axis=0), np.float32(0), obs[agent])
            for agent, shows in zip(self.possible_agents, self._shows, strict=True)
            if agent in obs
        }


class AmongNearest(Adapter):
    """
    mpe2's own limit of sight: agents observe their nearest teammates.

    :param env: the environment of mpe2, made with ``num_agent_neighbors``
    :param n_neighbors: how many these are
    """

    def __init__(self, env: ParallelEnv, n_neighbors: int):
        super().__init__(env)
        self.n_neighbors = n_neighbors
        self._world: Any = env.unwrapped.world

    def visibility(self) -> dict[str, np.ndarray]:
        """
        :return: bool [n_others] by agent: who is among its nearest after the last step, as the observation shows it
        """
        apart = distances(self._world)
        visible = {}
        for i, agent in enumerate(self.possible_agents):
            to_others = np.delete(apart[i], i)
            # the same call as mpe2's, so that two who are equally far do not change places
            visible[agent] = np.zeros(len(to_others), dtype=bool)
            visible[agent][np.argsort(to_others)[: self.n_neighbors]] = True
        return visible


def distances(world: Any) -> np.ndarray:
    """
    :param world: mpe2's world
    :return: of all agents from each other, float64 [n, n]
    """
    positions = np.array([agent.state.p_pos for agent in world.agents])
    return np.linalg.norm(positions[:, None] - positions[None], axis=-1)
