"""``TeamVecEnv`` over copies of a PettingZoo ``ParallelEnv``, in this process or in workers, held by SB3's own vectorisers."""

import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cached_property, partial
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from sb3_belief.common.action_masks import mask_width
from sb3_belief.common.exceptions import add_note
from sb3_belief.common.plain_data import PlainData
from sb3_belief.vec_env.joint_env import STATE, JointEnv, step_and_reset
from sb3_belief.vec_env.observation_forms import ObservationStack
from sb3_belief.vec_env.restarts import LastStep, Restarts, cut_step
from sb3_belief.vec_env.states import ENVIRONMENT, OBSERVATIONS, unbounded
from sb3_belief.vec_env.step_checks import StepChecks
from sb3_belief.vec_env.team_vec_env import TeamObs, TeamStep, TeamVecEnv
from sb3_belief.vec_env.validation import check_spaces
from sb3_belief.vec_env.workers import WorkersVecEnv


class ParallelTeamVecEnv(TeamVecEnv):
    """
    Copies of a team environment, each a ``JointEnv`` in SB3's ``DummyVecEnv`` or ``SubprocVecEnv``.

    What an environment raises is raised here, with a note that names copy and step, and the environment can go on. A worker
    process that dies or hangs ends it, with a ``WorkerError`` that says which one; the other workers are ended too. Ctrl-C is
    left to the main process: workers ignore it, and an interrupted step is finished before the next one.

    :param env_fns: One callable for each copy, which makes its ``JointEnv``
    :param subproc: Whether each copy gets a worker process of its own, instead of being stepped in this one
    :param step_timeout: Seconds within which a worker must answer, a start excepted; None for no limit
    :param restart_workers: How often each copy is made anew after it has failed in a step or reset
    :raises ValueError: For names or spaces that a team cannot have, or that are not the same in all copies
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], JointEnv]],
        subproc: bool = False,
        step_timeout: float | None = None,
        restart_workers: int = 0,
    ):
        self.venv: _InProcessVecEnv | WorkersVecEnv
        self._masks: np.ndarray | None = None
        # The environment's own states; None where they have to be asked for
        self._states: np.ndarray | None = None
        if subproc:
            self.venv = WorkersVecEnv(env_fns, step_timeout, restart_workers)
        else:
            envs = [env_fn() for env_fn in env_fns]
            if len({id(env.env) for env in envs}) < len(envs):
                raise ValueError("The copies are one and the same environment: return a new one at each call.")
            # Before DummyVecEnv fails on them with a message of its own
            first = envs[0]
            check_spaces(first.possible_agents, first.observation_spaces, first.action_spaces, first.scripted_action_spaces)
            self.venv = _InProcessVecEnv(envs, env_fns, restart_workers)
        try:
            agents, self._observation_spaces, self._action_spaces, scripted = self._common_members()
            super().__init__(
                len(env_fns), agents, self._observation_spaces, self._action_spaces, self.venv.render_mode, scripted
            )
        except BaseException:
            self.venv.close()
            raise
        self.venv.steps_so_far = lambda: self._lengths
        if isinstance(self.venv, WorkersVecEnv):
            self.venv.set_members(self._observation_spaces, self._action_spaces, self.scripted_action_spaces)
        self.reports_success = any(self.venv.get_attr("reports_success"))
        self._discrete = [isinstance(self._action_spaces[agent], spaces.Discrete) for agent in agents]
        self._mask_widths = [mask_width(self._action_spaces[agent]) for agent in agents]
        self._checks = StepChecks(agents, self._observation_spaces, self._action_spaces)

    def _common_members(self) -> list[Any]:
        """Return names, observation spaces and action spaces of the agents, and action spaces of the scripted others."""
        members = []
        for name in ("possible_agents", "observation_spaces", "action_spaces", "scripted_action_spaces"):
            first, *others = self.venv.get_attr(name)
            for copy, other in enumerate(others, start=1):
                if other != first:
                    raise ValueError(
                        f"All copies must have the same {name}, but those of environment copy {copy} are {other} and those of"
                        f" copy 0 are {first}."
                    )
            members.append(first)
        return members

    @property
    def n_restarts(self) -> int:
        """How often copies have been made anew after a fault."""
        return sum(self.venv.restarts.counts)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """
        Seed the copies: copy i gets ``seed + i`` at its next reset.

        :param seed: The seed, or None
        :return: The copies' seeds
        """
        self._seeds = list(self.venv.seed(seed))
        return self._seeds

    def set_options(self, options: list[dict] | dict | None = None) -> None:
        """
        Set the options of the copies' next reset.

        :param options: One dict for all copies, or a list of one for each
        """
        self.venv.set_options(options)

    def action_masks(self) -> dict[str, np.ndarray] | None:
        """
        Return the masks for the current observations.

        :return: bool ``[num_envs, k]`` by agent, or None if the environment has no masks
        """
        return None if self._masks is None else self._by_agent(self._masks)

    def _by_agent(self, masks: np.ndarray) -> dict[str, np.ndarray]:
        parts = np.split(masks, np.cumsum(self._mask_widths)[:-1], axis=1)
        columns = zip(self.possible_agents, parts, self._mask_widths, strict=True)
        return {agent: part for agent, part, width in columns if width}

    @cached_property
    def _own_state_width(self) -> int | None:
        return self.venv.env_method("state_width", indices=0)[0]

    @property
    def state_source(self) -> str:
        """Where states come from, as in the base class; for an environment without ``state_space`` a copy may be reset."""
        return OBSERVATIONS if self._own_state_width is None else ENVIRONMENT

    @property
    def state_space(self) -> spaces.Box:
        """The space of a state, float32 ``[d_s]``."""
        return super().state_space if self._own_state_width is None else unbounded(self._own_state_width)

    def states(self) -> np.ndarray:
        if self._own_state_width is None:
            return super().states()
        self._last_observations()
        self._asked_for_states = True
        if self._states is None:
            self._states = self._stack_states(self.venv.env_method("tell_state"))
        return self._states

    def _stack_states(self, rows: list[np.ndarray]) -> np.ndarray:
        for copy, row in enumerate(rows):
            if len(row) != self._own_state_width:
                raise ValueError(
                    f"state() of environment copy {copy} has {len(row)} entries, and had {self._own_state_width}: it must have"
                    " the same shape in all copies and at every step."
                )
        return np.stack(rows)

    def close(self) -> None:
        """End the workers, or close the copies."""
        super().close()
        self.venv.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        return self.venv.get_images()

    def has_attr(self, attr_name: str) -> bool:
        return attr_name == "action_masks" or self.venv.has_attr(attr_name)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        if attr_name == "action_masks":
            return super().get_attr(attr_name, indices)
        return self.venv.get_attr(attr_name, indices)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        # SB3's vectorisers would set it on the JointEnv around the user's environment
        self.env_method("set_env_attr", attr_name, value, indices=indices)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        if method_name == "action_masks":
            return super().env_method(method_name, indices=indices)
        return self.venv.env_method(method_name, *method_args, indices=indices, **method_kwargs)

    def _reset_joint(self) -> TeamObs:
        obs: Any = self.venv.reset()
        reset_infos = self.venv.reset_infos
        self._masks, self._states, self._checks.unable = None, None, {}
        if "action_masks" in reset_infos[0]:
            self._masks = np.array([info["action_masks"] for info in reset_infos])
            self._checks.check_masks(self._masks, np.zeros(self.num_envs, dtype=int))
        return obs

    def _copies_state(self) -> dict[str, Any]:
        # As text, which takes less than the tree when it is written once more
        copies = [(own, json.dumps(state.tree), state.blob) for own, state in self.venv.env_method("get_copy_state")]
        restarts = self.venv.restarts.state()
        return {"copies": copies, "masks": self._masks, "unable": dict(self._checks.unable), "restarts": restarts}

    def _set_copies_state(self, state: dict[str, Any]) -> None:
        # An environment has all its parts only after a reset
        self.reset()
        for copy, (own, tree, blob) in enumerate(state["copies"]):
            self.venv.env_method("set_copy_state", own, PlainData(json.loads(tree), blob), indices=copy)
        self._masks, self._checks.unable = state["masks"], state["unable"]
        self.venv.restarts.set_state(state["restarts"])

    def _step_joint(self, actions: TeamObs) -> TeamStep:
        # Plain integers for Discrete: what PettingZoo environments are tested with. Copies of others: an environment may write
        # into them, and the models keep theirs
        columns = [
            self._checks.check_discrete(agent, actions[agent], self._lengths)
            if discrete
            else self._checks.check_vectors(agent, actions[agent], self._lengths).copy()
            for agent, discrete in zip(self.possible_agents, self._discrete, strict=True)
        ]
        joint_actions: Any = [dict(zip(self.possible_agents, row)) for row in zip(*columns)]  # noqa: B905 (lengths are checked)
        try:
            step: Any = self.venv.step(joint_actions)
        except Exception as error:
            if self._checks.unable:
                add_note(error, str(self._checks.refuse_unable(*next(iter(self._checks.unable.items())))))
            raise
        obs, _, dones, infos = step
        if self._checks.unable:
            # A step that broke off tells nothing of who was in play in it
            self._checks.check_unable([{} if "worker_restarted" in info else info for info in infos])
        self._checks.check_finite(obs, self.venv.agent_rewards, self._lengths)
        if dones.any():
            self._tell_terminal_masks(dones, infos)
        if self.venv.action_masks is not None:
            self._masks = self.venv.action_masks
            self._checks.check_masks(self._masks, np.where(dones, 0, self._lengths + 1))
        return step

    def _tell_terminal_masks(self, dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
        """Give the last masks of ended episodes by agent; an episode that broke off ends with those of its last step."""
        for copy in np.flatnonzero(dones):
            info = infos[copy]
            if "worker_restarted" in info and self._masks is not None:
                info["terminal_action_masks"] = self._masks[copy]
            if "terminal_action_masks" in info:
                row = self._checks.possible(info["terminal_action_masks"])
                info["terminal_action_masks"] = {agent: part[0] for agent, part in self._by_agent(row[None]).items()}

    def _tell_terminal_states(self, dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
        if self._own_state_width is None:
            super()._tell_terminal_states(dones, infos)
            return
        for copy, info in enumerate(infos):
            if "worker_restarted" in info and self._states is not None:
                info["terminal_state"] = self._states[copy]
        rows = [info.pop(STATE, None) for info in infos]
        # A copy that was made anew does not know yet that it is to tell its states
        self._states = None if any(row is None for row in rows) else self._stack_states(rows)


class _InProcessVecEnv(DummyVecEnv):
    """
    SB3's ``DummyVecEnv`` for joint environments, without its deep copies.

    Observations are copied once, where they are stacked, and a ``JointEnv`` keeps nothing of its infos; further copies would
    take more time than all else that a joint step needs besides the environment.

    :param envs: The copies
    :param env_fns: One callable for each copy, which makes it anew
    :param restart_workers: How often a copy may be made anew
    """

    # As in WorkersVecEnv
    agent_rewards: np.ndarray
    action_masks: np.ndarray | None = None
    steps_so_far: Callable[[], Any]

    def __init__(self, envs: list[JointEnv], env_fns: Sequence[Callable[[], JointEnv]] = (), restart_workers: int = 0):
        # SB3's constructor is not called, because it would make buffers, which agents with Dict observations cannot have
        first = envs[0]
        self.envs: list[Any] = list(envs)
        self.metadata = first.metadata
        VecEnv.__init__(self, len(envs), first.observation_space, first.action_space)
        self._stack = ObservationStack(len(envs), first.observation_spaces)
        self.restarts, self._env_fns = Restarts(len(envs), restart_workers), list(env_fns)

    def reset(self) -> Any:
        """
        Reset all copies.

        :return: Observations ``[num_envs, ...]`` by agent
        """
        self.restarts.keep_seeds(self._seeds)
        resets = []
        for copy, (seed, options) in enumerate(zip(self._seeds, self._options, strict=True)):
            try:
                resets.append(self.envs[copy].reset(seed=seed, options=options or None))
            except Exception as error:
                resets.append(self._made_anew(copy, 0, error, options or None))
        self.reset_infos = [info for _, info in resets]
        self._reset_seeds()
        self._reset_options()
        stacked = self._stack([obs for obs, _ in resets])
        self.restarts.last = LastStep(stacked)
        return stacked

    def step_wait(self) -> VecEnvStepReturn:
        """
        Step all copies.

        :return: Observations ``[num_envs, ...]`` by agent, rewards float32 ``[num_envs]``, dones bool ``[num_envs]`` and infos
            as those of a ``TeamVecEnv``
        """
        envs: list[Any] = self.envs
        actions: Any = self.actions
        steps = []
        for env, action in zip(envs, actions, strict=True):
            try:
                steps.append(step_and_reset(env, action))
            except Exception as error:
                steps.append(self._cut(len(steps), error))
        observations, rewards, dones, records, masks, others = zip(*steps, strict=True)
        self.agent_rewards = np.array([record.agent_rewards for record in records], dtype=np.float32)
        infos = []
        for record, own_rewards, other in zip(records, self.agent_rewards, others, strict=True):
            active, life_end, truncated = record.flags
            info = {
                "agent_rewards": own_rewards,
                "visible": record.visible,
                "active": active,
                "life_end": life_end,
                "truncated": truncated,
            }
            if record.scripted_actions is not None:
                info["scripted_actions"] = record.scripted_actions
            if other:
                info.update(other)
            infos.append(info)
        self.action_masks = None if masks[0] is None else np.array(masks)
        stacked, ended = self._stack(observations), np.array(dones)
        self.restarts.last = LastStep(stacked, ended, infos)
        return stacked, np.array(rewards, dtype=np.float32), ended, infos

    def _cut(self, copy: int, error: Exception) -> Any:
        """Return the step of a copy that has raised an error in it."""
        obs, info = self._made_anew(copy, int(self.steps_so_far()[copy]) + 1, error)
        scripted_spaces = self.envs[copy].scripted_action_spaces
        return cut_step(copy, self.restarts.last, scripted_spaces, obs, info.get("action_masks"))

    def _made_anew(self, copy: int, step: int, cause: Exception, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Make a copy anew and reset it, or raise what has happened to it."""
        while self.restarts.allow(copy):
            seed = self.restarts.count(copy, step, cause)
            try:
                with suppress(Exception):
                    self.envs[copy].close()
                self.envs[copy] = self._env_fns[copy]()
                return self.envs[copy].reset(seed=seed, options=options)
            except Exception as error:
                cause = error
        raise cause

    def close(self) -> None:
        """
        Close all copies.

        :raises BaseException: What the first of them raised that could not be closed, once all others are
        """
        errors = []
        for env in self.envs:
            try:
                env.close()
            except Exception as error:
                env.name_place(error, "close()")
                errors.append(error)
        for first in errors:
            raise first

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        return self._of_each(f"attribute {attr_name!r}", partial(super().get_attr, attr_name), indices)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        call = partial(super().env_method, method_name, *method_args, **method_kwargs)
        return self._of_each(f"{method_name}()", lambda copy: call(indices=copy), indices)

    def _of_each(self, what: str, call: Callable[[int], list[Any]], indices: VecEnvIndices) -> list[Any]:
        """Ask one copy after the other, so that an error can name its copy."""
        results = []
        for copy in self._get_indices(indices):
            try:
                results += call(copy)
            except Exception as error:
                self.envs[copy].name_place(error, what)
                raise
        return results
