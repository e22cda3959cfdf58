"""
Observations that also hold the agent's last step, and a flag where another partner has come: for agents without a belief.

Both consist of what an agent gets in ``info`` at each step, and so of nothing that a belief is not given, except for the flag.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space

from sb3_belief.common.action_encoding import RowEncoder
from sb3_belief.vec_env.agent_vec_env import TransitionSplitter
from sb3_belief.vec_env.observation_forms import map_parts, row_of
from sb3_belief.vec_env.observe_window import ObserveWindowVecEnv
from sb3_belief.vec_env.team_vec_env import TeamObs, TeamStep, TeamVecEnv
from sb3_belief.vec_env.team_wrapper import TeamVecEnvWrapper
from sb3_belief.vec_env.validation import difference

#: Entry of a Dict observation for what was observed before, where it does not stand beside it in one vector
OBSERVATION = "observation"
#: Entry for the last step, where it cannot be appended to the observation
LAST_STEP = "last_step"
#: Entry that is 1 where another partner has come since the last step, and in the first observation after a reset
MEMORY_START = "memory_start"


class LastStepForm:
    """
    The form of an agent's observations that hold its last step, a flag for the start of its memory, or both.

    The last step is a vector float32 ``[W + n_others + w + 1]``: the others' actions as in ``info["others_actions"]`` (zero
    where not visible), whether each was visible, the agent's own action (encoded likewise; zero where it was out of play) and
    its own reward. It is appended to an observation that can be a vector, after encoding it as ``gymnasium.spaces.flatten``
    does, which for a Discrete one is one-hot. To a ``Dict`` it is added as the entry ``last_step``, and an image becomes a
    ``Dict`` of ``observation`` and ``last_step``. The flag is always an entry, ``memory_start``, a ``MultiBinary(1)``, since
    ``VecNormalize`` would make other numbers of it in a vector.

    :param agent: Name of the agent
    :param observation_space: Its observation space
    :param action_space: Its action space
    :param others: The action spaces of the others, in order
    :param last: Whether the observations hold the last step
    :param starts: Whether they hold the flag
    :raises ValueError: If the observation is a ``Dict`` that has an entry of such a name already
    """

    def __init__(
        self,
        agent: str,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        others: Mapping[str, spaces.Space],
        last: bool,
        starts: bool,
    ):
        self._action = RowEncoder(agent, action_space)
        #: Width of the last step
        self.width = (
            sum(RowEncoder(name, space).width for name, space in others.items()) + len(others) + self._action.width + 1
        )
        self._is_dict = isinstance(observation_space, spaces.Dict)
        self._flat: RowEncoder | None = None
        entries = dict(observation_space.spaces) if isinstance(observation_space, spaces.Dict) else {}
        added: dict[str, spaces.Space] = {}
        if not self._is_dict and last and not is_image_space(observation_space, check_channels=False):
            self._flat = RowEncoder(agent, observation_space)
            observation_space = _appended(observation_space, self._flat.width, self.width)
        elif last:
            added[LAST_STEP] = _unbounded(self.width)
        if starts:
            added[MEMORY_START] = spaces.MultiBinary(1)
        self._added = added.keys()
        taken = [name for name in added if name in entries]
        if taken:
            raise ValueError(
                f"The observation of {agent!r} has an entry {taken[0]!r} already, so its last step or the start of its memory"
                " cannot be added under that name: rename the entry in the environment."
            )
        #: The observation space in this form
        self.space = spaces.Dict({**(entries or {OBSERVATION: observation_space}), **added}) if added else observation_space

    def last_step(
        self, others_actions: np.ndarray, visible: np.ndarray, active: np.ndarray, actions: np.ndarray, rewards: np.ndarray
    ) -> np.ndarray:
        """
        Return the last step of ``n`` copies as the next observations hold it.

        :param others_actions: float32 ``[n, W]``, zero where not visible
        :param visible: bool ``[n, n_others]``
        :param active: Whether the agent was in play, bool ``[n]``
        :param actions: Its own actions, ``[n, ...]``
        :param rewards: Its own rewards, ``[n]``
        :return: float32 ``[n, width]``
        """
        # Not a product: the NaN of an action that was ignored must not come through
        own = np.where(active[:, None], self._action(actions), np.float32(0.0))
        return np.concatenate([others_actions, visible, own, rewards[:, None]], axis=1, dtype=np.float32)

    def join(self, obs: Any, last: np.ndarray, starts: np.ndarray) -> Any:
        """
        Return observations of ``n`` copies in this form.

        :param obs: ``[n, ...]``, an array or a dict of arrays
        :param last: The last step, float32 ``[n, width]``, zeros where there is none
        :param starts: Where the memory starts anew, bool ``[n]``
        :return: Observations in :attr:`space`, ``[n, ...]``
        """
        if self._flat is not None:
            obs = np.concatenate([self._flat(np.asarray(obs)), last], axis=1)
        if not self._added:
            return obs
        joined = dict(obs) if self._is_dict else {OBSERVATION: obs}
        if LAST_STEP in self._added:
            joined[LAST_STEP] = last.copy()
        if MEMORY_START in self._added:
            joined[MEMORY_START] = starts.astype(np.int8)[:, None]
        return joined


class ObserveLastVecEnv(TeamVecEnvWrapper):
    """
    Environment of a team in which agents also observe their last step, or where another partner has come, or both.

    At the start of an episode of its own, also where its life ends and it stays in the team, an agent observes zeros in place
    of the last step. One that is told of partners observes its last step over the ends of episodes too, for as long as the
    partner stays, and zeros where another has come. ``terminal_observation`` holds the step with which the episode ended. A
    partner of a pool that counts rollouts comes between two steps: the agent is told of it with the observation after the
    first of its steps, and observes that step.

    :param venv: Environment of the team
    :param observe_last: The agents that observe their last step; True for all, False for none
    :param partner_starts: The agents that are told, by the entry ``memory_start``, where another partner has come: the copy's
        ``partner`` is another than at the last step, whether or not an episode has ended there. True for all, False for none
    :raises ValueError: If an agent is unknown, if an observation has an entry of that name already, or if the environment does
        not say which partner is there
    """

    def __init__(
        self, venv: TeamVecEnv, observe_last: bool | Sequence[str] = True, partner_starts: bool | Sequence[str] = False
    ):
        agents = venv.possible_agents
        last = _chosen("observe_last", observe_last, agents)
        self._told = _chosen("partner_starts", partner_starts, agents)
        if self._told and not venv.has_attr("partner"):
            raise ValueError(
                "partner_starts (memory_span='partner') needs an environment that says which partner is there:"
                " env.get_attr('partner') with one name a copy, as tasks with partners that change have it. This one has none;"
                " leave it out."
            )
        observed: Any = venv.observation_space
        acted: Any = venv.action_space
        actions = {agent: acted[agent] for agent in agents}
        self._forms: dict[str, LastStepForm] = {}
        for agent in agents:
            if agent in last or agent in self._told:
                others = {other: space for other, space in actions.items() if other != agent} | venv.scripted_action_spaces
                args = agent, observed[agent], actions[agent], others
                self._forms[agent] = LastStepForm(*args, last=agent in last, starts=agent in self._told)
        self._splitter = TransitionSplitter(agents, actions, venv.scripted_action_spaces)
        self._partners: list[str] = []
        # In which copies a partner has come since the present observations were made
        self._came = np.zeros(venv.num_envs, dtype=bool)
        super().__init__(
            venv, {agent: self._forms[agent].space if agent in self._forms else observed[agent] for agent in agents}
        )

    def _reset_joint(self) -> TeamObs:
        obs = super()._reset_joint()
        self._other_partners()
        self._came[:] = False
        n_envs = self.num_envs
        starts = np.ones(n_envs, dtype=bool)
        first = {
            agent: form.join(obs[agent], np.zeros((n_envs, form.width), dtype=np.float32), starts)
            for agent, form in self._forms.items()
        }
        return {**obs, **first}

    def _step_joint(self, actions: TeamObs) -> TeamStep:
        obs, rewards, dones, infos = step = super()._step_joint(actions)
        others = self._other_partners()
        # Who came with a rollout has made this step already
        starts = others | self._came
        self._came[:] = False
        joined: TeamObs = dict(obs)
        nowhere = np.zeros(self.num_envs, dtype=bool)
        transitions = dict(zip(self.possible_agents, self._splitter.transitions(actions, step), strict=True))
        for agent, form in self._forms.items():
            own = transitions[agent]
            last = form.last_step(own.others_actions, own.others_visible, own.active, actions[agent], own.rewards)
            if own.ends:
                # Also where only its own return ends: the observation that follows holds no last step
                copies = list(own.ends)
                rows = (own.ends[copy]["terminal_observation"] for copy in copies)
                ends = form.join(map_parts(lambda *parts: np.stack(parts), *rows), last[copies], nowhere[: len(copies)])
                for k, copy in enumerate(copies):
                    infos[copy].setdefault("terminal_observation", {})[agent] = row_of(ends, k)
            last[others if agent in self._told else own.dones] = 0.0
            joined[agent] = form.join(obs[agent], last, starts)
        return joined, rewards, dones, infos

    def begin_rollout(self) -> None:
        super().begin_rollout()
        self._came |= self._other_partners()

    def _other_partners(self) -> np.ndarray:
        """Return in which copies there is another partner than when this was asked last, bool ``[num_envs]``."""
        if not self._told:
            return np.zeros(self.num_envs, dtype=bool)
        before, self._partners = self._partners, [str(name) for name in self.venv.get_attr("partner")]
        return np.array([old != new for old, new in zip(before or self._partners, self._partners, strict=True)])

    def _copies_state(self) -> dict[str, Any]:
        return {"env": super()._copies_state(), "partners": self._partners, "came": self._came.copy()}

    def _set_copies_state(self, state: dict[str, Any]) -> None:
        super()._set_copies_state(state["env"])
        self._partners, self._came = state["partners"], state["came"].copy()


def with_last_step(
    env: TeamVecEnv,
    observe_last: bool | Sequence[str] = False,
    partner_starts: bool | Sequence[str] = False,
    observe_window: int | Mapping[str, int] = 0,
) -> TeamVecEnv:
    """
    Let agents observe besides what an :class:`ObserveLastVecEnv` adds, and their last observations.

    :param env: Environment of a team, which is closed if it cannot be
    :param observe_last: As for ``ObserveLastVecEnv``
    :param partner_starts: As for ``ObserveLastVecEnv``
    :param observe_window: As for ``ObserveWindowVecEnv``; 0 for the observations as they are
    :return: The environment, as it is if nothing is asked for
    """
    try:
        if not (observe_last is False and partner_starts is False):
            env = ObserveLastVecEnv(env, observe_last, partner_starts)
        return ObserveWindowVecEnv(env, observe_window) if observe_window else env
    except BaseException:
        env.close()
        raise


def _chosen(name: str, given: bool | Sequence[str], agents: Sequence[str]) -> list[str]:
    if isinstance(given, bool):
        return list(agents) if given else []
    if isinstance(given, str) or not all(isinstance(agent, str) for agent in given):
        raise ValueError(f"{name}={given!r} must be True for all agents, False for none, or a list of names of agents.")
    _, unknown = difference(agents, given)
    if unknown:
        raise ValueError(f"{name} has the unknown agents {unknown}; the agents are {list(agents)}.")
    return list(given)


def _unbounded(width: int) -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, (width,), np.float32)


def _appended(space: spaces.Space, n_own: int, width: int) -> spaces.Box:
    """Return the space of a vector that holds an observation and the last step."""
    bounds = (space.low, space.high) if isinstance(space, spaces.Box) else (np.zeros(n_own), np.ones(n_own))
    last = np.full(width, np.inf)
    low, high = (
        np.concatenate([np.ravel(part), beyond]).astype(np.float32) for part, beyond in zip(bounds, (-last, last), strict=True)
    )
    return spaces.Box(low, high, dtype=np.float32)
