"""
The multi-particle environments of ``mpe2`` (``mpe/simple_spread_v3``), with an optional radius of sight.

Each agent gets its own reward as the environment returns it. ``simple_spread`` adds a share of a common reward, which
``local_ratio`` determines. An episode is truncated at ``max_cycles``.
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
    Return the names of mpe2's environments.

    :return: Names that follow ``mpe/`` in an id
    """
    return versioned_modules("mpe2", root="mpe2")


def make(name: str, radius: float | None = None, **env_kwargs: Any) -> ParallelEnv:
    """
    Make a multi-particle environment.

    In most of these tasks everything is visible, so by default every agent sees the actions of all others. With ``radius`` an
    agent sees only teammates within that distance. All others are set to zero in its observation, as mpe2 itself does for
    agents that are not observed, and their actions are not visible to it. Landmarks stay visible.

    :param name: Name of the environment, for instance ``"simple_spread_v3"``
    :param radius: Radius of sight, > 0, in the units of the positions (most tasks start within [-1, 1] x [-1, 1]). None for no
        limit
    :param env_kwargs: Keyword arguments of the environment. With mpe2's own ``num_agent_neighbors`` an agent sees the actions
        of those nearest agents that it observes
    :return: The parallel environment. It does not check whether actions lie in their spaces
    :raises ValueError: For an unknown name, a radius that is not positive, or a radius for a task whose observations do not
        allow one
    """
    known = names()
    if name not in known:
        raise unknown_name("mpe", name, known)
    neighbors = env_kwargs.get("num_agent_neighbors")
    if radius is not None:
        if not radius > 0:
            raise ValueError(f"radius={radius!r} must be greater than 0, or None for no limit.")
        if name not in LAYOUTS:
            reason = _REASONS.get(name, "it is not known where its observations show teammates")
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
        # raw_env lacks mpe2's wrappers that check actions and the order of calls, since a TeamVecEnv checks both
        env = MpeParallelEnv(module.raw_env(**env_kwargs))
    if radius is not None:
        return WithinRadius(env, radius, LAYOUTS[name])
    return env if neighbors is None else AmongNearest(env, neighbors)


class MpeParallelEnv(aec_to_parallel_wrapper):
    """
    Faster conversion of mpe2's AEC environments to parallel ones.

    PettingZoo's conversion computes all observations before each agent's action and discards them. Without that, and without
    mpe2's wrappers, a step takes half the time. It relies on two facts about mpe2: the world moves when the last agent acts,
    and all agents end together.
    """

    @property
    def action_names(self) -> dict[str, list[str]]:
        """The names of the actions of agents that move, and do nothing else."""
        moves = ["nothing", "left", "right", "down", "up"]
        agents = zip(self.possible_agents, self.aec_env.unwrapped.world.agents, strict=True)
        return {name: moves for name, agent in agents if agent.movable and agent.silent}

    def picture_positions(self) -> dict[str, tuple[float, float]]:
        """
        Return where the agents are in the picture.

        :return: {agent: (x, y)} as fractions of its width and height, from the upper left corner
        """
        world = self.aec_env.unwrapped.world
        # As mpe2 draws: what is farthest from the centre determines the scale
        scale = 0.45 / float(np.max(np.abs([entity.state.p_pos for entity in world.entities])))
        places = [agent.state.p_pos * scale for agent in world.agents]
        return {agent: (0.5 + x, 0.5 - y) for agent, (x, y) in zip(self.possible_agents, places, strict=True)}

    def step(self, actions: dict[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        """
        Let all agents act and return the results of the world's step.

        :param actions: Actions by agent
        :return: Observations, rewards, terminations, truncations and infos, by agent
        """
        env, agents = self.aec_env, self.aec_env.agents[:]
        for agent in agents:
            env.step(actions[agent])
        observations = {agent: env.observe(agent) for agent in agents}
        result = observations, dict(env.rewards), dict(env.terminations), dict(env.truncations), dict(env.infos)
        # An AEC environment removes agents that have ended when they are stepped with the action None
        while env.agents and (env.terminations[env.agent_selection] or env.truncations[env.agent_selection]):
            env.step(None)
        self.agents = env.agents
        return result


# The entries ("columns") of an agent's observation that show its teammates, one list for each of the others in order. The
# functions below compute them from the world and the index of the observing agent, following mpe2's source
Columns = list[list[int]]


def _runs(*parts: tuple[int, int], n_others: int) -> Columns:
    """
    Return the columns of others that are shown in consecutive blocks.

    :param parts: (start, width) of each part of the observation that has ``width`` columns for every other agent in turn
    :param n_others: Number of other agents
    :return: The columns of each of them
    """
    return [[start + k * width + c for start, width in parts for c in range(width)] for k in range(n_others)]


def _spread(world: Any, viewer: int) -> Columns:
    # Own velocity 2, own position 2, landmarks 2 each | others' positions 2 each | others' messages 2 each
    n_others, start = len(world.agents) - 1, 4 + 2 * len(world.landmarks)
    return _runs((start, 2), (start + 2 * n_others, world.dim_c), n_others=n_others)


def _reference(world: Any, viewer: int) -> Columns:
    # Own velocity 2, landmarks 2 each, goal's colour 3 | the other's message
    return _runs((2 + 2 * len(world.landmarks) + 3, world.dim_c), n_others=len(world.agents) - 1)


def _speaker_listener(world: Any, viewer: int) -> Columns:
    # Speaker: goal's colour. Listener: own velocity 2, landmarks 2 each | the speaker's message
    return [[]] if viewer == 0 else _runs((2 + 2 * len(world.landmarks), world.dim_c), n_others=1)


def _adversary(world: Any, viewer: int) -> Columns:
    # Only for good agents: goal's position 2. Landmarks 2 each | others' positions 2 each
    start = 2 * len(world.landmarks) + (0 if world.agents[viewer].adversary else 2)
    return _runs((start, 2), n_others=len(world.agents) - 1)


def _push(world: Any, viewer: int) -> Columns:
    # Adversary: own velocity 2, landmarks 2 each | others' positions. Good agent: own velocity 2, goal's position 2, own
    # colour 3, landmarks 2 each, their colours 3 each | others' positions
    n_landmarks = len(world.landmarks)
    start = 2 + 2 * n_landmarks if world.agents[viewer].adversary else 7 + 5 * n_landmarks
    return _runs((start, 2), n_others=len(world.agents) - 1)


def _tag(world: Any, viewer: int) -> Columns:
    # Own velocity 2, own position 2, landmarks 2 each | others' positions 2 each | the good others' velocities 2 each
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
    # The observation shows no teammate
    return [[] for _ in world.agents[1:]]


#: The tasks that allow a radius, and where their observations show teammates
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
    "simple_world_comm_v3": "its forests already hide agents, and observations say which agents are in them",
    "collect_treasure_v1": "it shows teammates in the order of their distance",
}


class WithinRadius(Adapter):
    """
    Wrapper that limits which teammates an agent sees to those within a radius.

    :param env: Environment of mpe2
    :param radius: Largest distance at which a teammate is visible
    :param layout: Function of the world and the index of an agent that returns the columns of its observation that show each
        teammate
    """

    def __init__(self, env: ParallelEnv, radius: float, layout: Callable[[Any, int], Columns]):
        super().__init__(env)
        self.radius = radius
        self._world: Any = env.unwrapped.world
        # For each observing agent a bool array [n_others, width] of the columns that show each other agent. A list, since the
        # widths of observations may differ
        self._shows = []
        for i, agent in enumerate(self.possible_agents):
            shows = np.zeros((len(self.possible_agents) - 1, *(env.observation_space(agent).shape or ())), dtype=bool)
            for k, columns in enumerate(layout(self._world, i)):
                shows[k, columns] = True
            self._shows.append(shows)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """
        Reset the environment and hide teammates beyond the radius.

        :param seed: Seed of the environment. With None its random generator continues
        :param options: Passed on to the environment
        :return: Observations and infos, by agent
        """
        obs, infos = self.env.reset(seed=seed, options=options)
        return self._blank(obs), infos

    def step(self, actions: dict[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        """
        Step the environment and hide teammates beyond the radius.

        :param actions: Actions by agent
        :return: Observations, rewards, terminations, truncations and infos, by agent
        """
        obs, rewards, terminations, truncations, infos = self.env.step(actions)
        return self._blank(obs), rewards, terminations, truncations, infos

    def visibility(self) -> dict[str, np.ndarray]:
        """
        Return which others are within the radius after the last step, which are those that the observation shows.

        :return: {agent: bool [n_others]}
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
    Wrapper that adds the visibility of actions for mpe2's own limit of sight, a number of nearest agents.

    :param env: Environment of mpe2, made with ``num_agent_neighbors``
    :param n_neighbors: The same number
    """

    def __init__(self, env: ParallelEnv, n_neighbors: int):
        super().__init__(env)
        self.n_neighbors = n_neighbors
        self._world: Any = env.unwrapped.world

    def visibility(self) -> dict[str, np.ndarray]:
        """
        Return which others are among the nearest after the last step, which are those that the observation shows.

        :return: {agent: bool [n_others]}
        """
        apart = distances(self._world)
        visible = {}
        for i, agent in enumerate(self.possible_agents):
            to_others = np.delete(apart[i], i)
            # The same call as in mpe2, so that agents at equal distances are ordered in the same way
            visible[agent] = np.zeros(len(to_others), dtype=bool)
            visible[agent][np.argsort(to_others)[: self.n_neighbors]] = True
        return visible


def distances(world: Any) -> np.ndarray:
    """
    Return the distances of all agents from each other.

    :param world: World of mpe2
    :return: float64 [n, n]
    """
    positions = np.array([agent.state.p_pos for agent in world.agents])
    return np.linalg.norm(positions[:, None] - positions[None], axis=-1)
