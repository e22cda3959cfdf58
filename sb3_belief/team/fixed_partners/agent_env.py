"""One agent of a team as a plain Gymnasium environment, in which fixed partners act for the others."""

import os
from collections.abc import Callable, Mapping
from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sb3_belief.envs.registry import make_parallel_env
from sb3_belief.team.agent_models import agent_seed
from sb3_belief.team.fixed_partners.partners import CallersRng, Partner, PartnerLike
from sb3_belief.vec_env.agent_vec_env import AgentStep, TransitionSplitter
from sb3_belief.vec_env.joint_env import JointEnv, Visibility
from sb3_belief.vec_env.parallel_team_vec_env import ParallelTeamVecEnv


class AgentEnv(gym.Env):
    """
    What one learner meets in a team of fixed partners: to learn with any SB3 algorithm alone, to adapt to new partners.

    The learner gets exactly what it would get in a ``Team``: its observation, its reward, and in ``info`` of a step
    ``others_actions`` float32 [W] (zero where not visible), ``others_visible`` bool [n_others] and ``active`` bool, at the end
    of the team's episode also ``is_success`` if the environment tells it. The others stand in the order of
    ``possible_agents`` without the learner, scripted others of the environment after them. ``action_masks()`` is there where
    the environment gives the learner masks.

    ``terminated`` and ``truncated`` are those of the learner's own return. Where it ends before the team's episode does, and
    the learner stays (``life_end``), the next ``reset()`` without seed and options goes on with that episode, as SB3's
    ``EpisodicLifeEnv`` does; a learner that has left for good does not wait: the partners play the rest of the episode within
    the step at which it leaves. Steps at which it is listed but out of play have ``active=False``.

    A partner is one of

    - an SB3 model; if it is normalised by ``VecNormalize``, its observations are too
    - the path of an SB3 zip, or of a saved team (then the agent of the same name acts; ``"team.zip:agent_0"`` takes another)
    - an object with SB3's ``predict(obs, state, episode_start, deterministic)``
    - a callable ``obs -> action``

    which is also given ``action_masks`` if it has such an argument (None where the environment has no masks for it).

    Each partner draws from a random stream of its own, seeded by ``reset(seed)``, so that the learner's does not depend on it.
    Worker processes (``SubprocVecEnv``) can be given paths and importable functions, but not every model.

    :param parallel_env: an id (see ``make_team_env``), a callable that makes a PettingZoo ``ParallelEnv``, or such an
        environment
    :param agent: name of the learner
    :param partners: {agent: partner} for all the others; or the path of a saved team, for all of them
    :param env_kwargs: keyword arguments of the environment, for an id or a callable
    :param visibility: as for ``make_team_env``
    :param deterministic: partners that predict take their most likely actions; False: they sample, as when they learned
    :param render_mode: of the environment, for an id or a callable
    :raises TypeError: for what is no environment or no partner
    :raises ValueError: for an unknown agent, agents without a partner, or partners that do not fit
    """

    # Those that gymnasium.make() may ask for; a made environment has its own
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
    ):
        kwargs = dict(env_kwargs or {})
        if render_mode is not None:
            kwargs["render_mode"] = render_mode
        joint = JointEnv(_make(parallel_env, kwargs), visibility)
        self._team_env = ParallelTeamVecEnv([lambda: joint])
        agents = self._team_env.possible_agents
        if agent not in agents:
            raise ValueError(f"There is no agent {agent!r} to learn; the environment has {agents}.")
        self.agent = agent
        #: The environment of the team
        self.parallel_env = joint.env
        self.observation_space = joint.observation_spaces[agent]
        # A copy: a model seeds its action space and samples from it
        self.action_space = deepcopy(joint.action_spaces[agent])
        self.metadata, self.render_mode = joint.metadata, joint.render_mode
        self.others_action_spaces: dict[str, spaces.Space] = {
            name: joint.action_spaces[name] for name in agents if name != agent
        } | joint.scripted_action_spaces

        self._joint, self._agents, self._deterministic = joint, agents, deterministic
        self._splitter = TransitionSplitter(agents, joint.action_spaces, joint.scripted_action_spaces)
        self._callers_rng = CallersRng(0)
        self._seed: int | None = None
        self._partners: dict[str, Partner] = {}
        self._obs: dict[str, np.ndarray] = {}
        self._ended: dict[str, bool] = {}
        # Whether step() may be called, and whether reset() is to go on from a done
        self._playing, self._pending = False, False
        others = [name for name in agents if name != agent]
        if isinstance(partners, (str, os.PathLike)):
            partners = dict.fromkeys(others, partners)
        if not isinstance(partners, Mapping):
            raise TypeError(
                f"partners must be a dict {{agent: partner}} or the path of a team, not {type(partners).__name__}."
            )
        missing = [name for name in others if name not in partners]
        if missing:
            raise ValueError(
                f"{missing} of this environment have no partner to act for them: partners must name each of {others}."
            )
        for name, partner in partners.items():
            self.set_partner(name, partner)

    def set_partner(self, name: str, partner: PartnerLike) -> None:
        """
        Let another partner act from the next step on; ``vec_env.env_method("set_partner", name, partner)`` in all copies.

        :param name: for whom it acts
        :param partner: see the class
        :raises TypeError: if it cannot act
        :raises ValueError: if it does not fit, or for a name that is not a partner's
        """
        others = [other for other in self._agents if other != self.agent]
        if name not in others:
            why = "the learner" if name == self.agent else "not an agent that a partner acts for"
            raise ValueError(f"{name!r} is {why}; partners act for {others}.")
        self._partners[name] = Partner(
            name,
            partner,
            self._joint.observation_spaces[name],
            self._joint.action_spaces[name],
            self._deterministic,
            self._seed_of(name),
        )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """
        :param seed: of the environment and of the partners' random numbers, None: they go on
        :param options: handed to the environment
        :return: the learner's observation and an empty info
        """
        super().reset(seed=seed)
        if seed is not None or options or not self._pending:
            if seed is not None:
                self._seed = seed
                self._team_env.seed(seed)
            if options:
                self._team_env.set_options(options)
            for name, partner in self._partners.items():
                partner.start_anew(None if seed is None else self._seed_of(name))
            self._obs = self._team_env.reset()
            self._ended = dict.fromkeys(self._agents, True)
        self._playing, self._pending = True, False
        return self._obs[self.agent][0], {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """
        :param action: of the learner
        :return: the learner's observation and reward, whether its return ended and whether it was cut, and info
        :raises RuntimeError: before ``reset()``
        """
        if not self._playing:
            raise RuntimeError(f"The episode of {self.agent!r} is over, or none has begun: call reset() first.")
        team_over, (observations, rewards, dones, infos) = self._step_team(action)
        obs, info = observations[0], infos[0]
        terminated = truncated = False
        if dones[0]:
            # Vectorised environments add these by themselves
            obs, truncated = np.asarray(info.pop("terminal_observation"))[()], info.pop("TimeLimit.truncated")
            terminated = not truncated
            info.pop("episode", None)
            if not team_over and self.agent not in self.parallel_env.agents:
                info.update(self._play_to_the_end(action))
            self._playing, self._pending = False, True
        return obs, float(rewards[0]), terminated, truncated, info

    @property
    def action_masks(self) -> Callable[[], np.ndarray]:
        """
        The method ``action_masks()``: which actions of the learner are possible now, bool [k]. Like an attribute that is not
        there where the environment gives it no masks, since that is how sb3-contrib finds out.
        """
        if not self._playing and not self._pending:
            # Whether there are masks shows at a reset, and sb3-contrib's evaluation asks before its own
            self.reset()
        if self.agent not in (self._team_env.action_masks() or {}):
            raise AttributeError(f"The environment gives {self.agent!r} no action masks.")
        return self._masks

    def render(self) -> Any:
        """
        :return: what the environment's own ``render()`` returns; after the end of an episode this shows the next one
        """
        return self._joint.render()

    def close(self) -> None:
        """Close the environment."""
        self._team_env.close()

    def _masks(self) -> np.ndarray:
        return self._team_env.action_masks()[self.agent][0]  # type: ignore[index]

    def _seed_of(self, name: str) -> int | None:
        return None if self._seed is None else agent_seed(self._seed, self._agents.index(name))

    def _step_team(self, action: Any) -> tuple[bool, AgentStep]:
        """
        :return: whether the team's episode is over (then the next one has begun), and the learner's part of the step
        """
        actions = {self.agent: np.asarray(action)[None]}
        masks = self._team_env.action_masks() or {}
        self._callers_rng.suspend()
        try:
            for name, partner in self._partners.items():
                partner.rng.resume()
                mask = masks[name][0] if name in masks else None
                actions[name] = partner.act(self._obs[name][0], self._ended[name], mask)[None]
                partner.rng.suspend()
        finally:
            self._callers_rng.resume()
        step = self._team_env.step(actions)
        parts = dict(zip(self._agents, self._splitter.split(actions, step), strict=True))
        self._obs = step[0]
        self._ended = {name: bool(part[2][0]) for name, part in parts.items()}
        return bool(step[2][0]), parts[self.agent]

    def _play_to_the_end(self, action: Any) -> dict[str, Any]:
        """
        :param action: any that the learner could do; nobody looks at it
        :return: what there is to say at the end of the team's episode
        """
        team_over = False
        while not team_over:
            team_over, (_, _, _, infos) = self._step_team(action)
        return {key: infos[0][key] for key in ("is_success",) if key in infos[0]}


def _make(env: Any, kwargs: dict[str, Any]) -> Any:
    """
    :return: one environment; whether it is a ``ParallelEnv`` is not looked at here
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
