"""One agent of a team as a plain Gymnasium environment, in which fixed partners act for the others."""

import os
from collections.abc import Callable, Iterable, Mapping
from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sb3_belief.common.safe_files.trust import Trust
from sb3_belief.envs.registry import make_parallel_env
from sb3_belief.team.agent_models import agent_seed
from sb3_belief.team.fixed_partners.partners import CallersRng, Partner, PartnerLike
from sb3_belief.vec_env.agent_vec_env import AgentStep, TransitionSplitter
from sb3_belief.vec_env.joint_env import JointEnv, Visibility
from sb3_belief.vec_env.observation_forms import map_parts, row_of
from sb3_belief.vec_env.parallel_team_vec_env import ParallelTeamVecEnv


class AgentEnv(gym.Env):
    """
    Gymnasium environment of a single learner in a team of fixed partners.

    Any SB3 algorithm can learn in it, for instance to adapt to new partners. The learner gets exactly what it would get in a
    ``Team``: its observation, its reward, and in the info of a step ``others_actions`` float32 ``[W]`` (zero where not
    visible), ``others_visible`` bool ``[n_others]`` and ``active`` bool, and what the environment's own info of the learner
    holds besides, under the same keys. If the environment reports ``is_success``, it is there whenever an episode of the
    learner ends: that of the team where the team's episode ends, too, and False where the team plays on. The others are in the
    order of ``possible_agents`` without the learner, followed by the environment's scripted others. ``action_masks()`` exists
    where the environment gives the learner masks.

    ``terminated`` and ``truncated`` describe the learner's own return. If it ends before the team's episode does and the
    learner stays (``life_end``), the next ``reset()`` without seed and options continues that episode, as SB3's
    ``EpisodicLifeEnv`` does. If the learner has left for good, the partners play the rest of the episode within the step in
    which it leaves. Steps in which it is still listed but out of play have ``active=False``.

    A partner is one of

    - an SB3 model; if ``VecNormalize`` normalises its observations, they are normalised here too
    - the path of an SB3 zip, or of a saved team (whose agent of the same name acts; ``"team.zip:agent_0"`` chooses another)
    - a pair of such a model or path and the ``VecNormalize`` that it has learned in, or the path of the file that
      ``VecNormalize.save`` wrote (a pickle, so with ``trust_pickle``); None for a model that needs none. The zip of a model
      does not say whether it does; if such a file lies beside it, a warning asks for the pair
    - an object with SB3's ``predict(obs, state, episode_start, deterministic)``
    - a callable ``obs -> action``

    A partner that has an argument ``action_masks`` is also given its masks (None if the environment has no masks for it).

    Each partner has random number generators of its own, seeded by ``reset(seed)``, so that the learner's random numbers do
    not depend on its partners. Worker processes (``SubprocVecEnv``) can be given paths and importable functions, but not every
    model.

    :param parallel_env: An id (see ``make_team_env``), a callable that makes a PettingZoo ``ParallelEnv``, or such an
        environment
    :param agent: Name of the learner
    :param partners: Partners of all other agents, by agent, or the path of a saved team from which all of them are taken
    :param env_kwargs: Keyword arguments of the environment, for an id or a callable
    :param visibility: As for ``make_team_env``
    :param deterministic: Whether partners with a ``predict`` take their most likely actions; False samples, as in training
    :param render_mode: Render mode of the environment, for an id or a callable
    :param trust_pickle: Whether to load what is pickled in the files of partners, too: files of SB3 alone and of earlier
        versions, and those of ``VecNormalize.save``. A pickle can run any code of whoever made the file
    :param allow_packages: Packages of your own of which the files of partners may name classes and functions
    :raises TypeError: If the environment or a partner is of an unsuitable type
    :raises ValueError: For an unknown agent, agents without a partner, or partners that do not fit
    """

    # gymnasium.make() reads the render modes from the class; an instance has the metadata of its own environment
    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"]}  # noqa: RUF012 (as gymnasium has it)

    def __init__(
        self,
        parallel_env: str | ParallelEnv | Callable[..., ParallelEnv],
        agent: str,
        partners: Mapping[str, PartnerLike] | str | os.PathLike,
        env_kwargs: Mapping[str, Any] | None = None,
        visibility: Visibility | None = None,
        deterministic: bool = False,
        render_mode: str | None = None,
        trust_pickle: bool = False,
        allow_packages: Iterable[str] = (),
    ):
        self._trust = Trust.of(trust_pickle, allow_packages)
        kwargs = dict(env_kwargs or {})
        if render_mode is not None:
            kwargs["render_mode"] = render_mode
        joint = JointEnv(_make(parallel_env, kwargs), visibility)
        self._team_env = ParallelTeamVecEnv([lambda: joint])
        agents = self._team_env.possible_agents
        # Agents are known by their names as text
        agent = str(agent)
        if agent not in agents:
            raise ValueError(f"There is no agent {agent!r} to learn; the environment has {agents}.")
        self.agent = agent
        #: The environment of the team
        self.parallel_env = joint.env
        self.observation_space = joint.observation_spaces[agent]
        # A copy, since a model seeds its action space and samples from it
        self.action_space = deepcopy(joint.action_spaces[agent])
        self.metadata, self.render_mode = joint.metadata, joint.render_mode
        self.others_action_spaces: dict[str, spaces.Space] = {
            name: joint.action_spaces[name] for name in agents if name != agent
        } | joint.scripted_action_spaces

        self._joint, self._agents, self._deterministic = joint, agents, deterministic
        self._others = [name for name in agents if name != agent]
        self._splitter = TransitionSplitter(agents, joint.action_spaces, joint.scripted_action_spaces)
        self._callers_rng = CallersRng(0)
        self._seed: int | None = None
        self._partners: dict[str, Partner] = {}
        self._obs: dict[str, Any] = {}
        self._ended: dict[str, bool] = {}
        # Whether an episode of the learner is running, so that step() may be called
        self._running = False
        # Whether the first observation of the learner's next episode is there already. It is after a done: either the
        # vectorised environment has reset itself, or the team's episode continues
        self._next_is_ready = False
        if isinstance(partners, (str, os.PathLike)):
            partners = dict.fromkeys(self._others, partners)
        if not isinstance(partners, Mapping):
            raise TypeError(
                f"partners must be a dict {{agent: partner}} or the path of a team, not {type(partners).__name__}."
            )
        partners = {str(name): partner for name, partner in partners.items()}
        missing = [name for name in self._others if name not in partners]
        if missing:
            raise ValueError(
                f"{missing} of this environment have no partner to act for them: partners must name each of {self._others}."
            )
        for name, partner in partners.items():
            self.set_partner(name, partner)

    def set_partner(self, name: str, partner: PartnerLike) -> None:
        """
        Replace a partner from the next step on.

        ``vec_env.env_method("set_partner", name, partner)`` does so in all copies.

        :param name: Name of the agent for which it acts
        :param partner: The new partner, see the class
        :raises TypeError: If it cannot act
        :raises ValueError: If it does not fit, or if no partner acts for an agent of that name
        """
        name = str(name)
        if name not in self._others:
            why = "the learner" if name == self.agent else "not an agent that a partner acts for"
            raise ValueError(f"{name!r} is {why}; partners act for {self._others}.")
        self._partners[name] = Partner(
            name,
            partner,
            self._joint.observation_spaces[name],
            self._joint.action_spaces[name],
            self._deterministic,
            self._seed_of(name),
            self._trust,
        )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """
        Begin an episode of the learner.

        :param seed: Seed of the environment and of the partners' random numbers; None continues with their generators as they
            are
        :param options: Passed on to the environment
        :return: The learner's observation and an empty info
        """
        super().reset(seed=seed)
        if seed is not None or options or not self._next_is_ready:
            if seed is not None:
                self._seed = seed
                self._team_env.seed(seed)
            if options:
                self._team_env.set_options(options)
            for name, partner in self._partners.items():
                partner.reset(None if seed is None else self._seed_of(name))
            self._obs = self._team_env.reset()
            self._ended = dict.fromkeys(self._agents, True)
        self._running, self._next_is_ready = True, False
        return row_of(self._obs[self.agent], 0), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """
        Step the team, with actions of the partners for the other agents.

        :param action: The learner's action
        :return: The learner's observation and reward, whether its return terminated, whether it was truncated, and the info
        :raises RuntimeError: If called before ``reset()``
        """
        if not self._running:
            raise RuntimeError(f"The episode of {self.agent!r} is over, or none has begun: call reset() first.")
        team_over, team_info, (observations, rewards, dones, infos) = self._step_team(action)
        obs, info = row_of(observations, 0), infos[0]
        terminated = truncated = False
        if dones[0]:
            # Removed from the info, because a vectorised environment around this one adds its own
            # [()] makes a number of an array without dimensions, as that of a Discrete space
            obs = map_parts(lambda last: np.asarray(last)[()], info.pop("terminal_observation"))
            truncated = info.pop("TimeLimit.truncated")
            terminated = not truncated
            info.pop("episode", None)
            if not team_over and self.agent not in self._joint.agents_in_play:
                team_info = self._play_to_the_end(action)
            if "is_success" in team_info or self._team_env.reports_success:
                # Always, since SB3's EvalCallback cannot save evaluations in which some episodes have it and some have not
                info["is_success"] = team_info.get("is_success", False)
            self._running, self._next_is_ready = False, True
        return obs, float(rewards[0]), terminated, truncated, info

    @property
    def action_masks(self) -> Callable[[], np.ndarray]:
        """
        The method ``action_masks()``, which returns the learner's possible actions, bool ``[k]``.

        The attribute does not exist where the environment gives the learner no masks, since that is what sb3-contrib looks at.

        :raises AttributeError: If there are no masks
        """
        if not self._running and not self._next_is_ready:
            # Whether there are masks is known only after a reset, and sb3-contrib's evaluation asks before it resets
            self.reset()
        if self.agent not in (self._team_env.action_masks() or {}):
            raise AttributeError(f"The environment gives {self.agent!r} no action masks.")
        return self._masks

    def render(self) -> Any:
        """Return what the environment's own ``render()`` returns; after the end of an episode this shows the next one."""
        return self._joint.render()

    def close(self) -> None:
        """Close the environment."""
        self._team_env.close()

    def _masks(self) -> np.ndarray:
        return self._team_env.action_masks()[self.agent][0]  # type: ignore[index]

    def _seed_of(self, name: str) -> int | None:
        return None if self._seed is None else agent_seed(self._seed, self._agents.index(name))

    def _step_team(self, action: Any) -> tuple[bool, dict[str, Any], AgentStep]:
        """
        Step the team with the learner's action and those of the partners.

        :param action: The learner's action
        :return: Whether the team's episode is over (the next one has then begun), the team's info, and the learner's part of
            the step
        """
        actions = {self.agent: np.asarray(action)[None]}
        masks = self._team_env.action_masks() or {}
        # SB3 models draw from the global generators, so each partner gets its own state of them while it acts
        self._callers_rng.suspend()
        try:
            for name, partner in self._partners.items():
                partner.rng.resume()
                mask = masks[name][0] if name in masks else None
                actions[name] = partner.act(row_of(self._obs[name], 0), self._ended[name], mask)[None]
                partner.rng.suspend()
        finally:
            self._callers_rng.resume()
        step = self._team_env.step(actions)
        agent_steps = dict(zip(self._agents, self._splitter.split(actions, step), strict=True))
        self._obs, _, team_dones, team_infos = step
        self._ended = {name: bool(dones[0]) for name, (_, _, dones, _) in agent_steps.items()}
        return bool(team_dones[0]), team_infos[0], agent_steps[self.agent]

    def _play_to_the_end(self, action: Any) -> dict[str, Any]:
        """
        Step the team to the end of its episode, after the learner has left.

        :param action: Any action of the learner; it is ignored
        :return: The team's info of the last step
        """
        team_over, team_info = False, dict[str, Any]()
        while not team_over:
            team_over, team_info, _ = self._step_team(action)
        return team_info


def _make(env: Any, kwargs: dict[str, Any]) -> Any:
    """
    Return the environment that an id, a callable or an environment stands for.

    Its type is not checked here, but by ``JointEnv``.
    """
    if isinstance(env, str):
        return make_parallel_env(env, **kwargs)
    if callable(env) and not isinstance(env, ParallelEnv):
        return env(**kwargs)
    if kwargs:
        raise ValueError(
            f"{list(kwargs)} cannot be set on an environment that is made already: pass its class or id instead of"
            f" a {type(env).__name__}."
        )
    return env
