"""``TeamVecEnv`` over copies of a PettingZoo ``ParallelEnv``, in this process or in workers, held by SB3's own vectorisers."""

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NoReturn

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from sb3_belief.common.exceptions import add_note
from sb3_belief.common.plain_data import PlainData
from sb3_belief.vec_env.action_masks import mask_parts, mask_width
from sb3_belief.vec_env.joint_env import JointEnv, step_and_reset
from sb3_belief.vec_env.observation_forms import parts_of
from sb3_belief.vec_env.team_vec_env import ObservationStack, TeamObs, TeamStep, TeamVecEnv
from sb3_belief.vec_env.validation import check_spaces, n_choices, not_a_choice, not_finite, place
from sb3_belief.vec_env.workers import WorkersVecEnv


class ParallelTeamVecEnv(TeamVecEnv):
    """
    Copies of a team environment, each a ``JointEnv`` in SB3's ``DummyVecEnv`` or ``SubprocVecEnv``.

    A worker process that dies ends the environment with a ``RuntimeError`` that says which one; the other workers are ended
    too. Ctrl-C is left to the main process: workers ignore it, and an interrupted step is finished before the next one.

    :param env_fns: One callable for each copy, which makes its ``JointEnv``
    :param subproc: Whether each copy gets a worker process of its own, instead of being stepped in this one
    :raises ValueError: For names or spaces that a team cannot have, or that are not the same in all copies
    """

    def __init__(self, env_fns: Sequence[Callable[[], JointEnv]], subproc: bool = False):
        self.venv: _InProcessVecEnv | WorkersVecEnv
        self._masks: np.ndarray | None = None
        if subproc:
            self.venv = WorkersVecEnv(list(env_fns))
        else:
            envs = [env_fn() for env_fn in env_fns]
            if len({id(env.env) for env in envs}) < len(envs):
                raise ValueError("The copies are one and the same environment: return a new one at each call.")
            # Before DummyVecEnv fails on them with a message of its own
            first = envs[0]
            check_spaces(first.possible_agents, first.observation_spaces, first.action_spaces, first.scripted_action_spaces)
            self.venv = _InProcessVecEnv(envs)
        try:
            agents, self._observation_spaces, self._action_spaces, scripted = self._common_members()
            super().__init__(
                len(env_fns), agents, self._observation_spaces, self._action_spaces, self.venv.render_mode, scripted
            )
        except BaseException:
            self.venv.close()
            raise
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

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """
        Seed the copies: copy i gets ``seed + i`` at its next reset.

        :param seed: The seed, or None
        :return: The copies' seeds
        """
        return self.venv.seed(seed)

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
        if self._masks is None:
            return None
        parts = np.split(self._masks, np.cumsum(self._mask_widths)[:-1], axis=1)
        columns = zip(self.possible_agents, parts, self._mask_widths, strict=True)
        return {agent: part for agent, part, width in columns if width}

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
        self._masks, self._checks.unable = None, {}
        if "action_masks" in reset_infos[0]:
            self._masks = np.array([info["action_masks"] for info in reset_infos])
            self._checks.check_masks(self._masks, np.zeros(self.num_envs, dtype=int))
        return obs

    def _copies_state(self) -> dict[str, Any]:
        # As text, which takes less than the tree when it is written once more
        copies = [(own, json.dumps(state.tree), state.blob) for own, state in self.venv.env_method("get_copy_state")]
        return {"copies": copies, "masks": self._masks, "unable": dict(self._checks.unable)}

    def _set_copies_state(self, state: dict[str, Any]) -> None:
        # An environment has all its parts only after a reset
        self.reset()
        for copy, (own, tree, blob) in enumerate(state["copies"]):
            self.venv.env_method("set_copy_state", own, PlainData(json.loads(tree), blob), indices=copy)
        self._masks, self._checks.unable = state["masks"], state["unable"]

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
            self._checks.check_unable(infos)
        self._checks.check_finite(obs, self.venv.agent_rewards, self._lengths)
        if self.venv.action_masks is not None:
            self._masks = self.venv.action_masks
            self._checks.check_masks(self._masks, np.where(dones, 0, self._lengths + 1))
        return step


class _InProcessVecEnv(DummyVecEnv):
    """
    SB3's ``DummyVecEnv`` for joint environments, without its deep copies.

    Observations are copied once, where they are stacked, and a ``JointEnv`` keeps nothing of its infos; further copies would
    take more time than all else that a joint step needs besides the environment.
    """

    # As in WorkersVecEnv
    agent_rewards: np.ndarray
    action_masks: np.ndarray | None = None

    def __init__(self, envs: list[JointEnv]):
        # SB3's constructor is not called, because it would make buffers, which agents with Dict observations cannot have
        first = envs[0]
        self.envs, self.metadata = list[Any](envs), first.metadata
        VecEnv.__init__(self, len(envs), first.observation_space, first.action_space)
        self._stack = ObservationStack(len(envs), first.observation_spaces)

    def reset(self) -> Any:
        """
        Reset all copies.

        :return: Observations ``[num_envs, ...]`` by agent
        """
        resets = [
            env.reset(seed=seed, options=options or None)
            for env, seed, options in zip(self.envs, self._seeds, self._options, strict=True)
        ]
        self.reset_infos = [info for _, info in resets]
        self._reset_seeds()
        self._reset_options()
        return self._stack([obs for obs, _ in resets])

    def step_wait(self) -> VecEnvStepReturn:
        """
        Step all copies.

        :return: Observations ``[num_envs, ...]`` by agent, rewards float32 ``[num_envs]``, dones bool ``[num_envs]`` and infos
            as those of a ``TeamVecEnv``
        """
        envs: list[Any] = self.envs
        actions: Any = self.actions
        steps = [step_and_reset(env, action) for env, action in zip(envs, actions, strict=True)]
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
        return self._stack(observations), np.array(rewards, dtype=np.float32), np.array(dones), infos


class StepChecks:
    """
    Checks of the joint steps of all copies at once.

    They first look for a sign that anything is wrong, which costs next to nothing, and only then for what it is.

    :param agents: Names of the agents
    :param observation_spaces: Observation space of each agent
    :param action_spaces: Action space of each agent
    """

    def __init__(
        self,
        agents: Sequence[str],
        observation_spaces: Mapping[str, spaces.Space],
        action_spaces: Mapping[str, spaces.Space],
    ):
        self._agents, self._action_spaces = list(agents), action_spaces
        self._floats = [
            (agent, key)
            for agent in agents
            for key, part in parts_of(observation_spaces[agent]).items()
            if np.issubdtype(part.dtype, np.floating)
        ]
        self._choices = [
            (agent, key, part, n_choices(part))
            for agent in agents
            for key, part in parts_of(observation_spaces[agent]).items()
            if n_choices(part) is not None
        ]
        self._bounds = {agent: _bounds(action_spaces[agent]) for agent in agents}
        parts = [(i, size) for i, agent in enumerate(agents) for size in mask_parts(action_spaces[agent])]
        # Whose each dimension of the masks is, and where it begins
        self._mask_owners = [i for i, _ in parts]
        self._mask_starts = np.cumsum([0, *(size for _, size in parts[:-1])])
        #: Agents whose present mask allows no action, {(copy, number of the agent): step}
        self.unable: dict[tuple[int, int], int] = {}

    def check_discrete(self, agent: str, chosen: np.ndarray, steps: np.ndarray) -> list[int]:
        """
        Check the actions of an agent with a ``Discrete`` action space.

        :param agent: Name of the agent
        :param chosen: Its actions, ``[num_envs]``
        :param steps: How many steps each copy's episode has had, int ``[num_envs]``
        :return: The actions as plain integers
        :raises ValueError: If one is not in its space
        """
        numbers = chosen.tolist()
        if chosen.dtype.kind not in "iub" or min(numbers) < 0 or max(numbers) > self._bounds[agent][1]:
            self._refuse_action(agent, chosen, steps)
        return numbers

    def check_vectors(self, agent: str, chosen: np.ndarray, steps: np.ndarray) -> np.ndarray:
        """
        Check the actions of an agent with another action space.

        :param agent: Name of the agent
        :param chosen: Its actions, ``[num_envs, ...]``
        :param steps: How many steps each copy's episode has had, int ``[num_envs]``
        :return: The actions
        :raises ValueError: If one is not in its space
        """
        low, high = self._bounds[agent]
        if not ((chosen >= low) & (chosen <= high)).all():
            self._refuse_action(agent, chosen, steps)
        return chosen

    def _refuse_action(self, agent: str, chosen: np.ndarray, steps: np.ndarray) -> NoReturn:
        low, high = self._bounds[agent]
        fits = ((chosen >= low) & (chosen <= high)).reshape(len(chosen), -1).all(axis=1)
        # Where all values fit, it is their dtype that does not, and copy 0 serves as the example
        copy = int(np.argmin(fits))
        raise ValueError(
            f"The action of {agent!r} {place(copy, int(steps[copy]) + 1)} is {chosen[copy].tolist()!r} (type {chosen.dtype}),"
            f" which is not in its action space {self._action_spaces[agent]}. An SB3 model's own actions are; clip or convert"
            " others."
        )

    def check_finite(self, obs: Mapping[str, Any], rewards: np.ndarray, steps: np.ndarray) -> None:
        """
        Check that observations and rewards are finite, and discrete observations in their spaces.

        :param obs: Observations by agent, ``[num_envs, ...]``
        :param rewards: Rewards of the agents, float32 ``[num_envs, n]``
        :param steps: How many steps each copy's episode has had, int ``[num_envs]``
        :raises ValueError: If a number is not finite, or an observation not in its space
        """
        for agent, key, space, n in self._choices:
            values = obs[agent] if key is None else obs[agent][key]
            fits = (values >= 0) & (values < n)
            if not fits.all():
                copy = int(np.argmin(fits.reshape(len(steps), -1).all(axis=1)))
                where = place(copy, int(steps[copy]) + 1)
                raise not_a_choice(_name(agent, key), values[copy], agent, space, where)
        for agent, key in self._floats:
            values = obs[agent] if key is None else obs[agent][key]
            if not _all_finite(values):
                copy = int(np.argmin(np.isfinite(values).reshape(len(steps), -1).all(axis=1)))
                raise not_finite(_name(agent, key), values[copy], place(copy, int(steps[copy]) + 1))
        if not _all_finite(rewards):
            copy, i = (int(k) for k in np.argwhere(~np.isfinite(rewards))[0])
            raise not_finite(f"reward of {self._agents[i]!r}", rewards[copy, i], place(copy, int(steps[copy]) + 1))

    def check_masks(self, masks: np.ndarray, steps: np.ndarray) -> None:
        """
        Find masks that allow no action, and let these allow the first one, since a model must choose something.

        :param masks: Masks of all agents side by side, bool ``[num_envs, width of all]``, changed in place
        :param steps: How many steps each copy's episode has had, int ``[num_envs]``
        """
        self.unable = {}
        if not self._mask_owners:
            return
        possible = np.logical_or.reduceat(masks, self._mask_starts, axis=1)
        if not possible.all():
            for copy, k in np.argwhere(~possible).tolist():
                masks[copy, self._mask_starts[k]] = True
                self.unable[copy, self._mask_owners[k]] = int(steps[copy])

    def check_unable(self, infos: list[dict[str, Any]]) -> None:
        """
        Check that agents whose masks allowed no action were out of play in the step that followed.

        Only now is it known: an agent that is not on turn, for instance, is.

        :param infos: Of that step
        :raises ValueError: If one was in play
        """
        for (copy, i), step in self.unable.items():
            if infos[copy]["active"][i]:
                raise self.refuse_unable((copy, i), step)

    def refuse_unable(self, which: tuple[int, int], step: int) -> ValueError:
        """
        Return the error for an agent whose mask allows no action although it is in play.

        :param which: Copy and number of the agent
        :param step: Of its episode, in which the mask was given
        """
        agent = self._agents[which[1]]
        return ValueError(
            f"The action mask of {agent!r} {place(which[0], step)} allows no action: a model must always choose one, so allow"
            " one that does nothing. If it could not act in the next step, as one that is not on turn, let the environment"
            f" say infos[{agent!r}]['active'] = False there. A turn-based AEC game is converted by"
            " sb3_belief.envs.to_parallel(env, turn_based=True)."
        )


def _name(agent: str, key: str | None) -> str:
    return f"observation of {agent!r}" if key is None else f"entry {key!r} of the observation of {agent!r}"


def _all_finite(values: np.ndarray) -> bool:
    # The fastest look at all numbers: zero times any number is zero, but not zero times NaN or infinity
    flat = values.reshape(-1)
    with np.errstate(invalid="ignore"):
        return flat.dot(np.zeros(flat.size, dtype=flat.dtype)) == 0.0


def _bounds(space: spaces.Space) -> tuple[Any, Any]:
    """Return the bounds of actions; for a ``Box`` with a margin, because rescaling rounds."""
    if isinstance(space, spaces.Discrete):
        return 0, int(space.n) - 1
    if isinstance(space, spaces.MultiDiscrete):
        return np.zeros_like(space.nvec), space.nvec - 1
    if isinstance(space, spaces.Box):
        low, high = space.low.astype(np.float64), space.high.astype(np.float64)
        margin = np.where(np.isfinite(low) & np.isfinite(high), 1e-4 * (high - low), 0.0)
        return low - margin, high + margin
    return 0, 1
