"""What agents are shown beside their own observations, where they learn centrally: the global state, and who they are."""

from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_belief.references.mappo import CRITIC_ID, OWN, STATE
from sb3_belief.vec_env.observation_forms import map_parts, row_of
from sb3_belief.vec_env.states import ENVIRONMENT
from sb3_belief.vec_env.team_vec_env import TeamObs, TeamStep, TeamVecEnv
from sb3_belief.vec_env.team_wrapper import TeamVecEnvWrapper

#: Entry of a Dict observation that says whose it is, one-hot
AGENT_ID = "agent_id"
#: Which global state is asked for: the environment's own, or any
STATES = ("env", "any")


def with_state(env: TeamVecEnv, state: str = "any") -> TeamVecEnv:
    """
    Show the critics of a team the global state (see ``references.mappo``).

    :param env: Environment of the team
    :param state: As for :class:`WithState`
    :return: The environment in which its models learn
    :raises ValueError: As for :class:`WithState`
    """
    return WithState(env, state)


class _ObservingMore(TeamVecEnvWrapper):
    """Environment in which an agent's observation holds more than that of the environment within."""

    def _whole(self, agent: str, own: Any, states: Any) -> Any:
        """Return some of an agent's observations with what they hold besides, ``[n, ...]`` each."""
        raise NotImplementedError

    def _states(self) -> Any:
        """Return what is added at present, ``[n_envs, ...]``; None for what never changes."""
        return None

    def _reset_joint(self) -> TeamObs:
        obs = super()._reset_joint()
        states = self._states()
        return {agent: self._whole(agent, obs[agent], states) for agent in self.possible_agents}

    def _step_joint(self, actions: TeamObs) -> TeamStep:
        obs, rewards, dones, infos = super()._step_joint(actions)
        states = self._states()
        for copy, info in enumerate(infos):
            if "terminal_observation" in info:
                # Who leaves early sees the present state; nothing has been reset then
                last = None if states is None else info["terminal_state"] if dones[copy] else states[copy]
                info["terminal_observation"] = {
                    agent: row_of(self._whole(agent, map_parts(one_row, own), None if last is None else last[None]), 0)
                    for agent, own in info["terminal_observation"].items()
                }
        return {agent: self._whole(agent, obs[agent], states) for agent in self.possible_agents}, rewards, dones, infos


class WithAgentId(_ObservingMore):
    """
    Appends a one-hot id to each agent's observation: at its end, for a Dict as the entry ``"agent_id"``.

    :param venv: The environment
    :raises ValueError: If an observation has no place for it
    """

    def __init__(self, venv: TeamVecEnv):
        agents, seen = venv.possible_agents, venv.observation_space
        self._ids = dict(zip(agents, np.eye(len(agents), dtype=np.float32), strict=True))
        super().__init__(venv, {agent: _with_id(seen[agent], len(agents)) for agent in agents})

    def _whole(self, agent: str, own: Any, states: Any) -> Any:
        if isinstance(own, dict):
            return {**own, AGENT_ID: np.tile(self._ids[agent], (len(next(iter(own.values()))), 1))}
        return np.concatenate([own, np.tile(self._ids[agent], (len(own), 1)).astype(own.dtype)], axis=-1)


class WithState(_ObservingMore):
    """
    Shows each agent the global state beside its own observation, for a critic that sees more than its actor.

    Observations are Dicts: the agent's own as the entry ``"obs"`` (or with its own entries, if it is a Dict), ``"state"``
    float32 ``[d_s]`` (``TeamVecEnv.states``), and for the critic ``"critic_id"``, whose it is, one-hot ``[n]``.

    :param venv: The environment
    :param state: ``"env"`` for the environment's own state only, ``"any"`` for all observations one after the other where it
        has none
    :raises ValueError: If ``state`` is neither, if the environment has no state of its own where ``"env"`` is asked for, or if
        an observation has an entry of these names
    """

    def __init__(self, venv: TeamVecEnv, state: str = "any"):
        if state not in STATES:
            raise ValueError(f"state is {state!r}; it must be one of {', '.join(map(repr, STATES))}")
        if state == "env" and venv.state_source != ENVIRONMENT:
            raise ValueError(
                "state='env' asks for the environment's own global state, but it has none (PettingZoo's state()): use"
                " state='any', which takes the observations of all agents one after the other."
            )
        agents, seen = venv.possible_agents, venv.observation_space
        self._ids = dict(zip(agents, np.eye(len(agents), dtype=np.float32), strict=True))
        more = {STATE: venv.state_space, CRITIC_ID: spaces.Box(0.0, 1.0, (len(agents),), dtype=np.float32)}
        shown: dict[str, spaces.Space] = {}
        for agent in agents:
            own = seen[agent]
            parts = own.spaces if isinstance(own, spaces.Dict) else {OWN: own}
            if taken := sorted(parts.keys() & more.keys()):
                raise ValueError(f"The observation of {agent!r} has the entries {taken} itself: rename them.")
            shown[agent] = spaces.Dict({**parts, **more})
        super().__init__(venv, shown)

    def _states(self) -> np.ndarray:
        return self.venv.states()

    def _whole(self, agent: str, own: Any, states: Any) -> dict[str, Any]:
        parts = own if isinstance(own, dict) else {OWN: own}
        return {**parts, STATE: states, CRITIC_ID: np.tile(self._ids[agent], (len(states), 1))}


def one_row(part: Any) -> np.ndarray:
    """
    Return a value as a batch of one.

    :param part: An array or a number
    """
    return np.asarray(part)[None]


def _with_id(space: spaces.Space, n: int) -> spaces.Space:
    identity = spaces.Box(0.0, 1.0, (n,), dtype=np.float32)
    if isinstance(space, spaces.Dict) and AGENT_ID not in space.spaces:
        return spaces.Dict({**space.spaces, AGENT_ID: identity})
    if isinstance(space, spaces.Box) and len(space.shape) == 1 and np.issubdtype(space.dtype, np.floating):
        low, high = (np.concatenate([own, bound]) for own, bound in ((space.low, identity.low), (space.high, identity.high)))
        return spaces.Box(low.astype(space.dtype), high.astype(space.dtype), dtype=space.dtype)
    raise ValueError(
        f"agent_id=True appends the agent's id to a vector of floats, or to a Dict as the entry {AGENT_ID!r}, but the"
        f" observation space is {space}: use agent_id=False."
    )
