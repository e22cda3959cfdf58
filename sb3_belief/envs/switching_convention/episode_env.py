"""The convention game as a task of changing teammates: a convention of its own in each copy and episode."""

from functools import lru_cache
from itertools import permutations
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from sb3_belief.common.checks import check_flag
from sb3_belief.envs.drawn_partner import partner_schedule
from sb3_belief.envs.switching_convention.parallel_env import FOLLOWER, SwitchingConvention
from sb3_belief.envs.switching_convention.vec_env import SwitchingConventionVecEnv
from sb3_belief.vec_env.team_vec_env import TeamObs, TeamStep

# A revealed convention takes m! entries of the policy's input, which are 720 here
_MOST_REVEALED = 6


def partner_name(convention: np.ndarray) -> str:
    """
    Return the name of a leader.

    :param convention: Its action at each cue, int64 [m]
    :return: The actions, such as ``"2-0-3-1"``
    """
    return "-".join(map(str, convention.tolist()))


@lru_cache(maxsize=_MOST_REVEALED)
def _numbers(m: int) -> dict[tuple[int, ...], int]:
    """Return the number of each convention, in lexicographic order."""
    return {actions: number for number, actions in enumerate(permutations(range(m)))}


def _told(cues: np.ndarray, conventions: np.ndarray) -> np.ndarray:
    """Return cues [n] beside the numbers of conventions [n, m], int64 [n, 2]."""
    numbers = _numbers(conventions.shape[1])
    return np.stack([cues, [numbers[tuple(row)] for row in conventions.tolist()]], axis=1)


def _observation_space(m: int, reveal_partner: bool) -> spaces.Space:
    check_flag("reveal_partner", reveal_partner)
    if not reveal_partner:
        return spaces.Discrete(m)
    if m > _MOST_REVEALED:
        raise ValueError(
            f"reveal_partner=True with m={m}: a convention of {m} cues is one of {m}!, too many for a one-hot code. Use m <="
            f" {_MOST_REVEALED}."
        )
    # Policies get a MultiDiscrete as one-hot codes side by side
    return spaces.MultiDiscrete([m, len(_numbers(m))])


class ConventionEpisode(SwitchingConvention):
    """
    The game of :class:`SwitchingConvention` with a convention that, as a rule, each copy draws anew in each episode.

    Weights cannot know it, and neither can a history of other copies or earlier episodes. What helps is a memory of this very
    episode that grows while it is played. Expected return of an episode of 64 steps with m=4, see
    :mod:`sb3_belief.envs.switching_convention.policies`: 64 for who knows the convention, 62.1 for an ideal memory, 16 for who
    has none.

    With ``reveal_partner`` the follower observes ``MultiDiscrete([m, m!])``, the cue and the number of the convention, which
    reach its policy as two one-hot codes. Infos of the team hold ``partner``, the leader's action at each cue as text; those
    of the follower do not.

    :param m: Number of cues and of actions, >= 2
    :param rollout_steps: Steps of an episode, >= 1. With ``redraw_unit="rollouts"`` also the learner's ``n_steps``
    :param redraw_every: Number of episodes (or rollouts) for which a convention is valid, >= 1. None if it never changes
    :param redraw_unit: ``"episodes"`` or ``"rollouts"``
    :param per_copy: Whether each copy has conventions of its own. False is for rollouts only
    :param partner_seed: Seed of the conventions, >= 0. With ``per_copy`` they depend on the seed of ``reset`` too
    :param reveal_partner: Whether the follower observes the convention, as nobody can outside of a comparison
    :param leader_visible: Whether the follower can observe the leader's actions
    :param render_mode: None or ``"rgb_array"``
    :raises ValueError: For any other value, and for ``reveal_partner`` with m > 6
    """

    metadata: ClassVar[dict[str, Any]] = {**SwitchingConvention.metadata, "name": "convention_episode_v0"}

    def __init__(
        self,
        m: int = 4,
        rollout_steps: int = 64,
        redraw_every: int | None = 1,
        redraw_unit: str = "episodes",
        per_copy: bool = True,
        partner_seed: int = 0,
        reveal_partner: bool = False,
        leader_visible: bool = True,
        render_mode: str | None = None,
    ):
        partner_schedule(redraw_every, redraw_unit, per_copy, partner_seed)
        super().__init__(
            m=m,
            K=redraw_every,
            rollout_steps=rollout_steps,
            leader_visible=leader_visible,
            seed=partner_seed,
            render_mode=render_mode,
            redraw_unit=redraw_unit,
            per_copy=per_copy,
        )
        self.observation_spaces = {FOLLOWER: _observation_space(m, reveal_partner)}
        self.reveal_partner = reveal_partner

    @property
    def partner(self) -> str:
        """The leader's action at each cue."""
        return partner_name(self.game.conventions[0])

    def step(
        self, actions: dict[str, int]
    ) -> tuple[dict[str, int], dict[str, float], dict[str, bool], dict[str, bool], dict[str, Any]]:
        """
        Advance the episode by one step.

        :param actions: Action of the follower, in [0, m)
        :return: As for :class:`SwitchingConvention`. The infos also hold ``partner``
        :raises ValueError: If the action is missing or outside its range, or if no episode is under way
        """
        partner = self.partner
        *step, infos = super().step(actions)
        return (*step, {**infos, "partner": partner})  # type: ignore[return-value]

    def _observe(self) -> Any:
        return _told(self.game.cue, self.game.conventions)[0] if self.reveal_partner else super()._observe()


class ConventionEpisodeVecEnv(SwitchingConventionVecEnv):
    """
    Vectorised environment of ``num_envs`` copies of :class:`ConventionEpisode` in one numpy game.

    ``seed(s)`` seeds copy i with s + i, which then behaves the same, bit for bit, as one :class:`ConventionEpisode` that is
    reset with the seed s + i at first and without a seed afterwards. ``get_attr("partner")`` returns the leader of each copy.

    :param num_envs: Number of environment copies, at least 1
    :param m: See :class:`ConventionEpisode`, also for the other arguments
    :param rollout_steps: Steps of an episode
    :param redraw_every: Number of episodes (or rollouts) for which a convention is valid
    :param redraw_unit: ``"episodes"`` or ``"rollouts"``
    :param per_copy: Whether each copy has conventions of its own
    :param partner_seed: Seed of the conventions
    :param reveal_partner: Whether the follower observes the convention
    :param leader_visible: Whether the follower can observe the leader's actions
    :param render_mode: None or ``"rgb_array"``
    :raises ValueError: For a value that is not allowed
    """

    def __init__(
        self,
        num_envs: int,
        m: int = 4,
        rollout_steps: int = 64,
        redraw_every: int | None = 1,
        redraw_unit: str = "episodes",
        per_copy: bool = True,
        partner_seed: int = 0,
        reveal_partner: bool = False,
        leader_visible: bool = True,
        render_mode: str | None = None,
    ):
        partner_schedule(redraw_every, redraw_unit, per_copy, partner_seed)
        super().__init__(
            num_envs,
            render_mode,
            m=m,
            K=redraw_every,
            rollout_steps=rollout_steps,
            leader_visible=leader_visible,
            seed=partner_seed,
            redraw_unit=redraw_unit,
            per_copy=per_copy,
        )
        self.observation_space = spaces.Dict({FOLLOWER: _observation_space(m, reveal_partner)})
        self.reveal_partner = reveal_partner

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """
        Return an attribute of each copy.

        :param attr_name: Name of the attribute. ``"convention"`` gives each copy's current convention, int64 [m], and
            ``"partner"`` its name
        :param indices: Indices of the copies. None for all
        :return: One value for each of these copies
        """
        if attr_name == "partner":
            return [partner_name(self.game.conventions[copy]) for copy in self._get_indices(indices)]
        return super().get_attr(attr_name, indices)

    def _step_joint(self, actions: TeamObs) -> TeamStep:
        partners = self.get_attr("partner")
        obs, rewards, dones, infos = super()._step_joint(actions)
        for info, partner in zip(infos, partners, strict=True):
            info["partner"] = partner
        return obs, rewards, dones, infos

    def _observe(self) -> TeamObs:
        return {FOLLOWER: _told(self.game.cue, self.game.conventions)} if self.reveal_partner else super()._observe()
