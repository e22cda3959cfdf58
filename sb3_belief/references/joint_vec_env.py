"""A team as one SB3 environment: its joint observation, the global state, a joint action and the team's reward."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from sb3_belief.references.one_learner import OneLearnerVecEnv
from sb3_belief.vec_env.observation_forms import map_parts, parts_of
from sb3_belief.vec_env.states import ObservedStates
from sb3_belief.vec_env.team_vec_env import TeamObs, TeamVecEnv


class JointVecEnv(VecEnvWrapper):
    """
    A ``TeamVecEnv`` of ``n`` agents as the environment of one model that acts for all of them.

    An observation has the entries

    - ``obs`` float32 ``[n, d]``: the agents' observations, each as ``gymnasium.spaces.flatten`` has it, then zeros up to the
      widest one
    - ``state`` float32 ``[d_s]``: the global state, see ``TeamVecEnv.states``
    - ``active`` ``[n]``: whether an agent is in play, as far as is known before it acts
    - ``mask`` ``[n, U]``, for Discrete actions: which are legal; the last are not for an agent with fewer. Where the
      environment leaves none, as it may to an agent out of play, it is the first, and so it is for one that has left

    Actions are MultiDiscrete, one for each agent, or a Box ``[n, W]`` of the agents' Box actions, each as a row that is filled
    up to the widest one by numbers in [-1, 1] that count for nothing. The reward is the team's, the end that of its episode.
    The info has what that of the ``TeamVecEnv`` has, ``terminal_observation`` in the form above, and, for each agent ``[n]``,
    ``in_play`` bool (whether it was when it acted), ``own_rewards`` float32 and ``own_ends`` bool (whether its own return
    ended, rather than being cut off by a limit). Where either is so while the team plays on, it also has ``last_obs``,
    {i: float32 ``[d]``}, the last observations of these agents.

    :param venv: The environment of the team
    :raises TypeError: If it is none
    :raises ValueError: For images, and for actions that are neither all Discrete nor all Box
    """

    venv: Any

    def __init__(self, venv: VecEnv):
        if not isinstance(venv, TeamVecEnv):
            raise TypeError(
                f"A JointVecEnv shows a TeamVecEnv as one, such as make_team_env() makes, not {type(venv).__name__}."
            )
        self._agents, observed, acted = venv.possible_agents, venv.observation_space, venv.action_space
        assert isinstance(observed, spaces.Dict) and isinstance(acted, spaces.Dict)
        for agent in self._agents:
            if any(is_image_space(part) for part in parts_of(observed[agent]).values()):
                raise ValueError(
                    f"{agent!r} observes images ({observed[agent]}), and joint learners take vectors: give the environment a"
                    " wrapper that makes vectors of them."
                )
        self._flat = {agent: ObservedStates({agent: observed[agent]}) for agent in self._agents}
        self._acted: list[Any] = [acted[agent] for agent in self._agents]
        n, width = len(self._agents), max(flat.width for flat in self._flat.values())
        parts: dict[str, spaces.Space] = {
            "obs": spaces.Box(-np.inf, np.inf, (n, width), np.float32),
            "state": venv.state_space,
            "active": spaces.MultiBinary(n),
        }
        #: Number of actions of the agent that has most; 0 for Box actions
        self.n_actions = 0
        if all(isinstance(space, spaces.Discrete) for space in self._acted):
            sizes = [int(space.n) for space in self._acted]
            self.n_actions = max(sizes)
            parts["mask"] = spaces.MultiBinary([n, self.n_actions])
            joint: spaces.Space = spaces.MultiDiscrete(sizes)
        elif all(isinstance(space, spaces.Box) for space in self._acted):
            sizes = [int(np.prod(space.shape)) for space in self._acted]
            low, high = (np.full((n, max(sizes)), bound, dtype=np.float32) for bound in (-1, 1))
            for i, (space, size) in enumerate(zip(self._acted, sizes, strict=True)):
                low[i, :size], high[i, :size] = space.low.ravel(), space.high.ravel()
            joint = spaces.Box(low, high, dtype=np.float32)
        else:
            kinds = {agent: str(acted[agent]) for agent in self._agents}
            raise ValueError(f"Joint learners take agents' actions that are all Discrete, or all Box, not {kinds}.")
        super().__init__(venv, spaces.Dict(parts), joint)

    def reset(self) -> dict[str, np.ndarray]:
        obs = self.venv.reset()
        active = np.ones((self.num_envs, len(self._agents)), dtype=np.int8)
        return self._joint(obs, self.venv.states(), active, self.venv.action_masks())

    def step_async(self, actions: np.ndarray) -> None:
        self.venv.step_async(
            {
                agent: self._own_actions(actions[:, i], space)
                for i, (agent, space) in enumerate(zip(self._agents, self._acted, strict=True))
            }
        )

    @staticmethod
    def _own_actions(rows: np.ndarray, space: Any) -> np.ndarray:
        if isinstance(space, spaces.Discrete):
            return rows
        return rows[:, : int(np.prod(space.shape))].reshape(-1, *space.shape).astype(space.dtype)

    def step_wait(self) -> VecEnvStepReturn:
        obs, rewards, dones, infos = self.venv.step_wait()
        active = np.stack([self._active(info) for info in infos])
        shown = [{**info, **self._of_each(info, bool(done))} for info, done in zip(infos, dones, strict=True)]
        for copy, info in enumerate(infos):
            if "terminal_observation" not in info:
                continue
            last = {agent: map_parts(_one_row, own) for agent, own in info["terminal_observation"].items()}
            if dones[copy]:
                masks = {agent: own[None] for agent, own in info.get("terminal_action_masks", {}).items()}
                row = self._joint(last, info["terminal_state"][None], active[[copy]], masks)
                shown[copy]["terminal_observation"] = {key: part[0] for key, part in row.items()}
            else:
                shown[copy]["last_obs"] = {self._agents.index(agent): self._rows(agent, own)[0] for agent, own in last.items()}
        # Those that have ended are at the beginning of another episode
        active[dones] = 1
        return self._joint(obs, self.venv.states(), active, self.venv.action_masks()), rewards, dones, shown

    def action_masks(self) -> np.ndarray | None:
        """
        Return the agents' masks side by side, as for a MultiDiscrete action.

        :return: bool ``[num_envs, sum of the agents' numbers of actions]``, or None if the environment has none
        """
        masks = self.venv.action_masks()
        if masks is None or not self.n_actions:
            return None
        free = {
            agent: np.ones((self.num_envs, int(s.n)), dtype=bool) for agent, s in zip(self._agents, self._acted, strict=True)
        }
        return np.concatenate([masks.get(agent, free[agent]) for agent in self._agents], axis=1)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        if method_name == "action_masks":
            masks = self.action_masks()
            return [None if masks is None else masks[i] for i in self._get_indices(indices)]
        return super().env_method(method_name, *method_args, indices=indices, **method_kwargs)

    def _rows(self, agent: str, obs: Any) -> np.ndarray:
        """Return observations of an agent, ``[k, ...]``, in the form of all, float32 ``[k, d]``."""
        flat, space = self._flat[agent]({agent: obs}), self.observation_space["obs"]  # type: ignore[index]
        rows = np.zeros((len(flat), space.shape[1]), dtype=np.float32)
        rows[:, : flat.shape[1]] = flat
        return rows

    @staticmethod
    def _of_each(info: dict[str, Any], done: bool) -> dict[str, np.ndarray]:
        """Return what an info says of each agent, under names of its own: the others are read by a team's own environment."""
        ended = done and not info["TimeLimit.truncated"]
        ends = np.ones_like(info["life_end"]) if ended else info["life_end"]
        return {"in_play": info["active"], "own_rewards": info["agent_rewards"], "own_ends": ends}

    def _active(self, info: dict[str, Any]) -> np.ndarray:
        """Return who is in play after a step: as the environment says, otherwise who was and whose return goes on."""
        said = info.get("agent_infos", {})
        goes_on = info["active"] & ~info["life_end"]
        return np.array(
            [said.get(a, {}).get("next_active", goes) for a, goes in zip(self._agents, goes_on, strict=True)], np.int8
        )

    def _joint(
        self, obs: TeamObs, states: np.ndarray, active: np.ndarray, masks: Mapping[str, np.ndarray] | None
    ) -> dict[str, np.ndarray]:
        space: Any = self.observation_space
        rows = np.stack([self._rows(agent, obs[agent]) for agent in self._agents], axis=1)
        joint = {"obs": rows, "state": states.astype(np.float32), "active": active}
        if self.n_actions:
            joint["mask"] = np.zeros((len(active), *space["mask"].shape), dtype=np.int8)
            for i, (agent, actions) in enumerate(zip(self._agents, self._acted, strict=True)):
                legal = True if masks is None or agent not in masks else masks[agent]
                joint["mask"][:, i, : int(actions.n)] = legal
            joint["mask"][..., 0] |= ~joint["mask"].any(axis=-1)
        return joint


def _one_row(part: Any) -> np.ndarray:
    return np.asarray(part)[None]


def joint_team(env: TeamVecEnv) -> TeamVecEnv:
    """
    Return a team's environment as that of a single agent, ``"team"``, which acts for all: for a ``Team`` of one joint learner.

    :param env: The environment of the team
    :return: The same as a :class:`JointVecEnv` shows it
    :raises ValueError: See :class:`JointVecEnv`
    """
    return OneLearnerVecEnv(env, JointVecEnv(env))
