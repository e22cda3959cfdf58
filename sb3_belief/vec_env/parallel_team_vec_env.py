"""``TeamVecEnv`` over copies of a PettingZoo ``ParallelEnv``, in this process or in workers, held by SB3's own vectorisers."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NoReturn

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from sb3_belief.vec_env.joint_env import JointEnv, mask_width, step_and_reset
from sb3_belief.vec_env.team_vec_env import TeamObs, TeamStep, TeamVecEnv
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
            self.venv = _InProcessVecEnv([partial(_same, env) for env in envs])
            self.venv.layout = [
                (agent, (len(envs), *(space.shape or ())), space.dtype) for agent, space in first.observation_spaces.items()
            ]
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
        self._checks = StepChecks(agents, self._observation_spaces, self._action_spaces, self._mask_widths)

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
        self._masks = None
        if "action_masks" in reset_infos[0]:
            self._masks = np.array([info["action_masks"] for info in reset_infos])
            self._checks.check_masks(self._masks, np.zeros(self.num_envs, dtype=int))
        return obs

    def _step_joint(self, actions: TeamObs) -> TeamStep:
        # Plain integers for Discrete: what PettingZoo environments are tested with
        columns = [
            (self._checks.check_discrete if discrete else self._checks.check_vectors)(agent, actions[agent], self._lengths)
            for agent, discrete in zip(self.possible_agents, self._discrete, strict=True)
        ]
        joint_actions: Any = [dict(zip(self.possible_agents, row)) for row in zip(*columns)]  # noqa: B905 (lengths are checked)
        step: Any = self.venv.step(joint_actions)
        obs, _, dones, _ = step
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

    # Agent, shape and dtype of its stacked observations
    layout: list[tuple[str, tuple[int, ...], Any]]
    # As in WorkersVecEnv
    agent_rewards: np.ndarray
    action_masks: np.ndarray | None = None

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
        # concatenate() takes a third of the time of array()
        stack = partial(np.concatenate, axis=None, casting="unsafe")
        stacked = {
            agent: stack([obs[agent] for obs in observations], dtype=dtype).reshape(shape)
            for agent, shape, dtype in self.layout
        }
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
        return stacked, np.array(rewards, dtype=np.float32), np.array(dones), infos


def _same(env: JointEnv) -> JointEnv:
    return env


class StepChecks:
    """
    Checks of the joint steps of all copies at once.

    They first look for a sign that anything is wrong, which costs next to nothing, and only then for what it is.

    :param agents: Names of the agents
    :param observation_spaces: Observation space of each agent
    :param action_spaces: Action space of each agent
    :param mask_widths: Width of each agent's mask, in order; 0 for an agent that cannot be masked
    """

    def __init__(
        self,
        agents: Sequence[str],
        observation_spaces: Mapping[str, spaces.Space],
        action_spaces: Mapping[str, spaces.Space],
        mask_widths: Sequence[int],
    ):
        self._agents, self._action_spaces = list(agents), action_spaces
        self._floats = [agent for agent in agents if np.issubdtype(observation_spaces[agent].dtype, np.floating)]
        choices = {agent: n_choices(observation_spaces[agent]) for agent in agents}
        self._choices = {agent: n for agent, n in choices.items() if n is not None}
        self._observation_spaces = observation_spaces
        self._bounds = {agent: _bounds(action_spaces[agent]) for agent in agents}
        self._masked = [agent for agent, width in zip(agents, mask_widths, strict=True) if width]
        self._mask_starts = [sum(mask_widths[:i]) for i, width in enumerate(mask_widths) if width]

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

    def check_finite(self, obs: Mapping[str, np.ndarray], rewards: np.ndarray, steps: np.ndarray) -> None:
        """
        Check that observations and rewards are finite, and discrete observations in their spaces.

        :param obs: Observations by agent, ``[num_envs, ...]``
        :param rewards: Rewards of the agents, float32 ``[num_envs, n]``
        :param steps: How many steps each copy's episode has had, int ``[num_envs]``
        :raises ValueError: If a number is not finite, or an observation not in its space
        """
        for agent, n in self._choices.items():
            fits = (obs[agent] >= 0) & (obs[agent] < n)
            if not fits.all():
                copy = int(np.argmin(fits.reshape(len(steps), -1).all(axis=1)))
                where = place(copy, int(steps[copy]) + 1)
                raise not_a_choice(agent, obs[agent][copy], self._observation_spaces[agent], where)
        for agent in self._floats:
            if not _all_finite(obs[agent]):
                copy = int(np.argmin(np.isfinite(obs[agent]).reshape(len(steps), -1).all(axis=1)))
                raise not_finite(f"observation of {agent!r}", obs[agent][copy], place(copy, int(steps[copy]) + 1))
        if not _all_finite(rewards):
            copy, i = (int(k) for k in np.argwhere(~np.isfinite(rewards))[0])
            raise not_finite(f"reward of {self._agents[i]!r}", rewards[copy, i], place(copy, int(steps[copy]) + 1))

    def check_masks(self, masks: np.ndarray, steps: np.ndarray) -> None:
        """
        Check that masks allow at least one action.

        :param masks: Masks of all agents side by side, bool ``[num_envs, sum of mask_widths]``
        :param steps: How many steps each copy's episode has had, int ``[num_envs]``
        :raises ValueError: If a mask allows nothing
        """
        if not self._masked:
            return
        possible = np.logical_or.reduceat(masks, self._mask_starts, axis=1)
        if not possible.all():
            copy, i = (int(k) for k in np.argwhere(~possible)[0])
            raise ValueError(
                f"The action mask of {self._masked[i]!r} {place(copy, int(steps[copy]))} allows no action: a model must always"
                " choose one, so allow one that does nothing, also for an agent that is out of play."
            )


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
