"""What shows a team's environment to models that learn centrally."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize, unwrap_vec_normalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from sb3_belief.common.action_masks import mask_width
from sb3_belief.references.one_learner import OneLearnerVecEnv
from sb3_belief.references.with_state import WithAgentId, WithState, one_row
from sb3_belief.team.normalization import AgentNormalize
from sb3_belief.vec_env.agent_vec_env import TransitionSplitter
from sb3_belief.vec_env.observation_forms import map_parts, row_of
from sb3_belief.vec_env.team_vec_env import TeamObs, TeamVecEnv


def shared_weights(env: TeamVecEnv, agent_id: bool = True) -> OneLearnerVecEnv:
    """
    Show a team to one model that acts for each agent with the same weights (see ``references.shared``).

    :param env: Environment of agents with equal spaces
    :param agent_id: Whether an observation says whose it is
    :return: The environment of the one learner
    :raises ValueError: If the agents' spaces differ, or an observation has no place for the id
    """
    _equal_spaces(env)
    env = WithAgentId(env) if agent_id else env
    return OneLearnerVecEnv(env, StackedVecEnv(env))


def shared_with_state(env: TeamVecEnv, state: str = "any", agent_id: bool = True) -> OneLearnerVecEnv:
    """
    Show a team to one model with the same weights for each agent, whose critic sees the global state.

    :param env: Environment of agents with equal spaces
    :param state: As for :class:`WithState`
    :param agent_id: Whether the actor, too, sees whose an observation is
    :return: The environment of the one learner
    :raises ValueError: As for :class:`WithState` and :func:`shared_weights`
    """
    _equal_spaces(env)
    env = WithState(WithAgentId(env) if agent_id else env, state)
    return OneLearnerVecEnv(env, StackedVecEnv(env))


class StackedVecEnv(VecEnv):
    """
    Shows the agents' observations as one array, stacked in the order of the agents: ``[n_envs, n, ...]``.

    Actions are stacked likewise. Reward, done and info are the team's; ``info["rows"]`` holds what each agent is given of the
    step: ``rewards`` and ``dones``, ``[n]``, ``infos``, a list of dicts, and where one is done ``last``, their last
    observations, ``[n, ...]``.

    :param venv: Environment of agents with equal spaces
    :raises ValueError: If the agents' spaces differ
    """

    def __init__(self, venv: TeamVecEnv):
        self.venv, self._agents = venv, venv.possible_agents
        seen, done = _equal_spaces(venv)
        self._mask_width = mask_width(done)
        n = len(self._agents)
        self._splitter = TransitionSplitter(
            self._agents,
            dict(venv.action_space.spaces),  # type: ignore[attr-defined]
            venv.scripted_action_spaces,
        )
        self._actions: TeamObs = {}
        super().__init__(venv.num_envs, stacked_space(seen, n), stacked_space(done, n))

    def reset(self) -> Any:
        return self._stack(self.venv.reset())

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = {agent: actions[:, i] for i, agent in enumerate(self._agents)}

    def step_wait(self) -> VecEnvStepReturn:
        step = self.venv.step(self._actions)
        obs, rewards, dones, infos = step
        shown = self._stack(obs)
        transitions = self._splitter.transitions(self._actions, step)
        own_rewards, own_dones = (np.stack([getattr(t, name) for t in transitions], axis=1) for name in ("rewards", "dones"))
        result = []
        for copy, info in enumerate(infos):
            own = [
                {"active": bool(t.active[copy]), **({} if t.own_infos is None else t.own_infos[copy]), **t.ends.get(copy, {})}
                for t in transitions
            ]
            rows = {"rewards": own_rewards[copy], "dones": own_dones[copy], "infos": own}
            said = {**info, "rows": rows}
            if own_dones[copy].any():
                # Of those who are not done the present one, which nobody asks for
                last = {
                    agent: map_parts(one_row, each.get("terminal_observation", row_of(obs[agent], copy)))
                    for agent, each in zip(self._agents, own, strict=True)
                }
                rows["last"] = said["terminal_observation"] = row_of(self._stack(last), 0)
            result.append(said)
        return shown, rewards, dones, result

    def action_masks(self) -> np.ndarray | None:
        """
        Return the agents' masks side by side.

        :return: bool ``[n_envs, n * k]``, or None if the environment has none
        """
        masks = self.venv.action_masks()
        if masks is None:
            return None
        free = np.ones((self.num_envs, self._mask_width), dtype=bool)
        return np.concatenate([masks.get(agent, free) for agent in self._agents], axis=1)

    def _stack(self, obs: TeamObs) -> Any:
        own: list[Any] = [obs[agent] for agent in self._agents]
        if isinstance(own[0], dict):
            return {key: np.stack([part[key] for part in own], axis=1) for key in own[0]}
        return np.stack(own, axis=1)

    # The rest is the team's environment's

    def close(self) -> None:
        self.venv.close()

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        return self.venv.seed(seed)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        return self.venv.get_attr(attr_name, indices)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        self.venv.set_attr(attr_name, value, indices)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        return self.venv.env_method(method_name, *method_args, indices=indices, **method_kwargs)

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        return self.venv.env_is_wrapped(wrapper_class, indices)


class SharedVecEnv(VecEnvWrapper):
    """
    Shows each agent of each copy as a row of its own, ``n * n_envs`` of them: agent i of copy e is the row ``e * n + i``.

    A row has the agent's own observation, reward and done, and in its info ``active``, as the agent's own environment in a
    ``Team`` has them. So a model that learns here acts for all agents with the same weights. In a ``Team`` that normalises
    observations, it is one statistic for all agents as well.

    :param venv: Shows the agents' observations stacked: :class:`StackedVecEnv`, or what a team hands to its one learner
    :raises ValueError: If it shows something else, or normalises rewards, which are the team's there
    """

    def __init__(self, venv: VecEnv):
        shape = venv.action_space.shape
        parts = venv.observation_space
        seen = list(parts.spaces.values()) if isinstance(parts, spaces.Dict) else [parts]
        if not shape or any(not part.shape or part.shape[0] != shape[0] for part in seen):
            raise ValueError(
                f"A model that shares weights needs the agents' observations and actions stacked, not {venv.observation_space}"
                f" and {venv.action_space}: make its environment by sb3_belief.references.adapters.shared_weights(env)."
            )
        if isinstance(venv, VecNormalize) and venv.norm_reward:
            raise ValueError(
                "Rewards of agents that share weights cannot be normalised, since there is one statistic for the team's: use"
                " normalize: {norm_reward: false}, and value_norm for values of any scale."
            )
        #: How many agents there are
        self.n_agents = int(shape[0])
        self._statistics = unwrap_vec_normalize(venv)
        if isinstance(self._statistics, AgentNormalize):
            self._statistics.share_places()
        super().__init__(venv, row_space(venv.observation_space), row_space(venv.action_space))
        self.num_envs = venv.num_envs * self.n_agents

    def reset(self) -> Any:
        return to_rows(self.venv.reset())

    def step_async(self, actions: np.ndarray) -> None:
        self.venv.step_async(actions.reshape(self.venv.num_envs, self.n_agents, *actions.shape[1:]))

    def step_wait(self) -> VecEnvStepReturn:
        obs, _, _, infos = self.venv.step_wait()
        rows: list[dict[str, Any]] = []
        for info in infos:
            for agent, own in enumerate(info["rows"]["infos"]):
                if "terminal_observation" in own:
                    # SB3 normalises it only where the whole copy is done
                    last = info["rows"]["last"]
                    last = last if self._statistics is None else self._statistics.normalize_obs(last)
                    own = {**own, "terminal_observation": row_of(last, agent)}
                rows.append(own)
        rewards, ended = (np.concatenate([info["rows"][name] for info in infos]) for name in ("rewards", "dones"))
        return to_rows(obs), rewards, ended, rows

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        if attr_name == "others_action_spaces":
            raise AttributeError("Rows that share weights have no others.")
        return [self.venv.get_attr(attr_name)[row // self.n_agents] for row in self._get_indices(indices)]

    def has_attr(self, attr_name: str) -> bool:
        return attr_name != "others_action_spaces" and super().has_attr(attr_name)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        answers = self.venv.env_method(method_name, *method_args, **method_kwargs)
        if method_name == "action_masks":
            answers = [mask for masks in answers for mask in np.reshape(masks, (self.n_agents, -1))]
        else:
            answers = [answer for answer in answers for _ in range(self.n_agents)]
        return [answers[row] for row in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        answers = self.venv.env_is_wrapped(wrapper_class)
        return [answers[row // self.n_agents] for row in self._get_indices(indices)]


def stacked_space(space: spaces.Space, n: int) -> spaces.Space:
    """
    Return the space of ``n`` values of a space, stacked along a new first dimension.

    :param space: Discrete, MultiDiscrete, MultiBinary, Box, or a Dict of these
    :param n: Number of values
    """
    if isinstance(space, spaces.Dict):
        return spaces.Dict({key: stacked_space(part, n) for key, part in space.spaces.items()})
    if isinstance(space, spaces.Discrete):
        return spaces.MultiDiscrete([space.n] * n)
    if isinstance(space, spaces.MultiDiscrete):
        return spaces.MultiDiscrete(np.stack([space.nvec] * n))
    if isinstance(space, spaces.MultiBinary):
        return spaces.MultiBinary([n, *space.shape])
    assert isinstance(space, spaces.Box)
    return spaces.Box(np.stack([space.low] * n), np.stack([space.high] * n), dtype=space.dtype)


def row_space(space: spaces.Space) -> spaces.Space:
    """
    Return the space of one of the values that are stacked.

    :param space: As of :func:`stacked_space`
    """
    if isinstance(space, spaces.Dict):
        return spaces.Dict({key: row_space(part) for key, part in space.spaces.items()})
    if isinstance(space, spaces.MultiDiscrete):
        return spaces.Discrete(int(space.nvec[0])) if space.nvec.ndim == 1 else spaces.MultiDiscrete(space.nvec[0])
    if isinstance(space, spaces.MultiBinary):
        return spaces.MultiBinary(space.shape[1] if len(space.shape) == 2 else list(space.shape[1:]))
    assert isinstance(space, spaces.Box)
    return spaces.Box(space.low[0], space.high[0], dtype=space.dtype)


def to_rows(stacked: Any) -> Any:
    """
    Return stacked values as rows.

    :param stacked: ``[n_envs, n, ...]``, or a dict of such arrays
    :return: ``[n_envs * n, ...]``
    """
    if isinstance(stacked, dict):
        return {key: to_rows(part) for key, part in stacked.items()}
    return stacked.reshape(-1, *stacked.shape[2:])


def _equal_spaces(env: TeamVecEnv) -> tuple[spaces.Space, spaces.Space]:
    """Return the observation and the action space that all agents have."""
    agents, common = env.possible_agents, []
    for kind, found in (("observation", env.observation_space), ("action", env.action_space)):
        first: spaces.Space = found[agents[0]]  # type: ignore[index]
        for agent in agents[1:]:
            if found[agent] != first:  # type: ignore[index]
                raise ValueError(
                    f"Agents that share weights need equal spaces, but the {kind} space of {agents[0]!r} is {first} and that"
                    f" of {agent!r} is {found[agent]}: pad them (supersuit.pad_observations_v0, pad_action_space_v0), or"  # type: ignore[index]
                    " train one model for each agent (--algo ippo, mappo)."
                )
        common.append(first)
    return common[0], common[1]
