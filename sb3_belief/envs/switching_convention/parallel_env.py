"""The switching convention as a PettingZoo environment."""

from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from sb3_belief.envs.base import TeamGame, check_render_mode, require_render_mode
from sb3_belief.envs.switching_convention.game import ConventionConfig, ConventionGame
from sb3_belief.envs.switching_convention.rendering import draw_convention

FOLLOWER, LEADER = "follower", "leader"


class SwitchingConvention(TeamGame[int, int]):
    """
    Game in which a follower has to match a scripted leader, whose behaviour changes every K rollouts.

    The follower observes a cue x, drawn uniformly from m cues, while the leader plays c(x). The convention c is a permutation
    of range(m). The follower gets the reward 1 if it played the same action, and otherwise 0. The leader's action is never in
    an observation. The follower receives it after the step in ``others_actions``, like that of a teammate. All that an agent
    can know about a convention is therefore in its history, and a new convention is drawn uniformly every K rollouts.

    The game tests whether a belief is *dynamic*, that is whether it follows a change of another agent's behaviour without a
    gradient step. Weights alone cannot, since all conventions are equally likely to be the next one. Mean reward per step:

    ========================================================  ===========================  ================================
    game                                                      without history              optimum
    ========================================================  ===========================  ================================
    ``convention-swap`` (T1): train with K=2, then freeze     1/m on a fresh convention    1.0 there, once the history holds
    all weights and let the history record a fresh                                         each cue of it
    convention (another ``seed``, K=None)
    ``convention-watch-act`` (T2): K=2, only the second       1/m in the second            1.0 in the second
    rollout is rewarded                                       rollout                      rollout
    ``convention-redraw`` (T3): K=5, every rollout is         1/m, or more by what is      (K-1+1/m)/K: 1/m in a
    rewarded                                                  learned within K rollouts    convention's first rollout, then 1
    ========================================================  ===========================  ================================

    A belief cannot help in these negative controls:

    - ``K=1``: the history lags by one rollout and so always holds another convention. The optimum is 1/m
    - ``leader_visible=False``: only the reward tells anything about the leader
    - ``K=None``: the leader is stationary, and any learner matches it by its weights alone (1.0)

    A history that is no longer than a rollout, ``history_length <= rollout_steps * n_envs``, holds one convention only. The
    mean over all rollouts of ``convention-watch-act`` is at most 1/2, since it includes the first ones, which are not
    rewarded. During training read ``rollout/ep_rew_mean`` (at most ``rollout_steps``) instead of an evaluation. An evaluation
    environment counts its own steps, so its convention is not the one that the follower's history holds.

    An episode has ``rollout_steps`` steps and terminates, since no step has consequences for later ones and there is nothing
    to bootstrap from. A convention is valid across episodes, for ``K * rollout_steps`` steps of the environment. A reset with
    a seed starts again with the first convention. A reset without one does not change it.

    :param m: Number of cues and of actions, >= 2
    :param K: Number of rollouts for which a convention is valid, >= 1. None if it never changes
    :param rollout_steps: Steps of one copy in a rollout, >= 1. It must equal the learner's ``n_steps``
    :param rewarded: ``"always"``, or ``"last"`` to reward only the last of a convention's K rollouts
    :param leader_visible: Whether the follower can observe the leader's actions
    :param seed: Seed of the sequence of conventions, >= 0. All copies made with the same seed have the same leader. The seed
        of ``reset`` determines the cues
    :param render_mode: None or ``"rgb_array"``
    :param redraw_unit: ``"rollouts"``, or ``"episodes"`` for a convention that is valid for K episodes
    :param per_copy: Whether each copy has conventions of its own, which depend on its seed too. ``"episodes"`` need it
    :raises ValueError: For any other value, and for ``rewarded="last"`` with ``K=None``
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "switching_convention_v0",
        "render_modes": ["rgb_array"],
        "is_parallelizable": True,
    }

    def __init__(
        self,
        m: int = 4,
        K: int | None = 5,
        rollout_steps: int = 16,
        rewarded: str = "always",
        leader_visible: bool = True,
        seed: int = 0,
        render_mode: str | None = None,
        redraw_unit: str = "rollouts",
        per_copy: bool = False,
    ):
        self.render_mode = check_render_mode(render_mode, ("rgb_array",))
        self.config = ConventionConfig(m, K, rollout_steps, rewarded, leader_visible, seed, redraw_unit, per_copy)
        self.game = ConventionGame(1, self.config)
        self.possible_agents = [FOLLOWER]
        self.agents: list[str] = []
        self.observation_spaces: dict[str, spaces.Space] = {FOLLOWER: spaces.Discrete(m)}
        self.action_spaces: dict[str, spaces.Space] = {FOLLOWER: spaces.Discrete(m)}
        self.scripted_action_spaces: dict[str, spaces.Space] = {LEADER: spaces.Discrete(m)}

    @property
    def convention(self) -> np.ndarray:
        """The leader's action at each cue in the next step, int64 [m]."""
        return self.game.conventions[0].copy()

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, int], dict[str, dict[str, Any]]]:
        """
        Start an episode.

        :param seed: Seed of the cues, and with ``per_copy`` of the conventions. The environment also starts again with its
            first convention. With None both the cues and the conventions continue
        :param options: Not used
        :return: The first cue and an empty info, by agent
        """
        if seed is not None:
            self.game.seed(0, seed)
        self.game.reset()
        self.agents = [FOLLOWER]
        return {FOLLOWER: self._observe()}, {FOLLOWER: {}}

    def _observe(self) -> Any:
        """Return what the follower observes."""
        return int(self.game.cue[0])

    def step(
        self, actions: dict[str, int]
    ) -> tuple[dict[str, int], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """
        Advance the episode by one step.

        :param actions: Action of the follower, in [0, m)
        :return: Next cue, reward, termination (True at the last step of an episode), truncation (False) and an empty info, by
            agent
        :raises ValueError: If the action is missing or outside its range, or if no episode is under way
        """
        self._require_episode()
        if FOLLOWER not in actions:
            raise ValueError(f"No action for {FOLLOWER!r}, the agent that acts here; got actions for {list(actions)}.")
        action = actions[FOLLOWER]
        if action not in range(self.config.m):
            raise ValueError(f"The action of {FOLLOWER!r} is {action!r}; allowed are the integers 0 to {self.config.m - 1}.")
        rewards, dones = self.game.step(np.array([action]))
        done = bool(dones[0])
        if done:
            self.agents = []
        obs, reward = {FOLLOWER: self._observe()}, {FOLLOWER: float(rewards[0])}
        return obs, reward, {FOLLOWER: done}, {FOLLOWER: False}, {FOLLOWER: {}}

    def scripted_actions(self) -> dict[str, int]:
        """
        Return the leader's action of the last step.

        :return: Its action at the cue that the follower observed before that step, in [0, m)
        """
        return {LEADER: int(self.game.leader[0])}

    def visibility(self) -> dict[str, np.ndarray]:
        """
        Return whether the follower could observe the leader's action of the last step.

        :return: {follower: bool [1]}
        """
        return {FOLLOWER: np.array([self.config.leader_visible])}

    def render(self) -> np.ndarray:
        """
        Return a picture of the convention, the cue and the last actions.

        :return: uint8 [height, width, 3]
        :raises ValueError: If the environment was made without a render mode
        """
        require_render_mode(self.render_mode, ("rgb_array",))
        return draw_convention(self.game, 0)

    def get_state(self) -> dict[str, Any]:
        """
        Return everything that determines the rest of this episode and the following ones.

        :return: Arrays and plain data
        """
        return {"game": self.game.get_state(0), "under_way": bool(self.agents)}

    def set_state(self, state: dict[str, Any]) -> None:
        """
        Restore a state. With the same actions, everything that follows is then the same bit for bit.

        :param state: State that ``get_state`` returned in an environment with the same arguments
        :raises ValueError: If the arguments differ
        """
        self.game.set_state(0, state["game"])
        self.agents = [FOLLOWER] if state["under_way"] else []
