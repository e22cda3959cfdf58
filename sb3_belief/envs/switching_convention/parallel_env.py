"""The switching conventions as a PettingZoo environment."""

from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from sb3_belief.envs.base import TeamGame
from sb3_belief.envs.switching_convention.game import ConventionConfig, ConventionGame

FOLLOWER, LEADER = "follower", "leader"


class SwitchingConvention(TeamGame[int, int]):
    """
    A follower sees a cue x, uniform of m, and at the same time a scripted leader plays c(x): c, the convention, is a
    permutation of range(m). The follower is rewarded with 1 if it played the same, else with 0. What the leader did is never
    in an observation: the follower learns of it afterwards, by ``others_actions``, as of a teammate. All that an
    agent can know of a convention is thus in its history, and a new one is drawn, uniformly, every K rollouts.

    These are tests of whether a belief is *dynamic*: whether it follows a change of the other's behaviour without a gradient
    step. Weights cannot do it, since the next convention is as likely one as the other:

    ========================================================  ===========================  ================================
    the game                                                  without history              the best there is
    ========================================================  ===========================  ================================
    ``convention-swap`` (T1): train with K=2, then freeze     1/m on a fresh convention    1.0 there, once the history holds
    all weights and let the history watch a fresh                                          each cue of it
    convention (another ``seed``, K=None)
    ``convention-watch-act`` (T2): K=2, the reward counts     1/m in the second            1.0 in the second
    in the second rollout only                                rollout
    ``convention-redraw`` (T3): K=5, the reward counts        1/m, or more by what is      (K-1+1/m)/K: 1/m in a
    always                                                    learned within K rollouts    convention's first rollout, then 1
    ========================================================  ===========================  ================================

    Negative controls, in which a belief cannot help: ``K=1`` (a history lags by one rollout, so it is always of another
    convention: 1/m is the best), ``leader_visible=False`` (nothing can be known but by reward), and ``K=None``, a stationary
    leader that any learner comes to match by its weights alone (1.0).

    For a history to hold one convention only, let it be no longer than a rollout: ``history_length <= rollout_steps *
    n_envs``. Averages over all rollouts of ``convention-watch-act`` count the first ones too, which are not rewarded: 1/2 at
    best. Read ``rollout/ep_rew_mean`` (of ``rollout_steps`` at most) and not an evaluation during training: an evaluation
    environment lives a life of its own, so its convention is not the one that the follower's history is of.

    An episode is ``rollout_steps`` long and ends by termination: no step has consequences for a later one, so there is nothing
    to bootstrap from. Conventions do not change with episodes but every ``K * rollout_steps`` steps of the environment's
    life; a reset with a seed begins that life anew, one without a seed goes on.

    :param m: number of cues and of actions, >= 2
    :param K: number of rollouts for which a convention lives, >= 1; None: for ever
    :param rollout_steps: steps of one copy in a rollout, >= 1: must equal the learner's ``n_steps``
    :param rewarded: ``"always"``, or ``"last"``: the reward counts only in the last of a convention's K rollouts
    :param leader_visible: whether the follower is told what the leader did
    :param seed: decides the sequence of conventions, >= 0. All copies made with it meet the same one, since it is the same
        leader; the seed given to ``reset`` decides the cues.
    :raises ValueError: for a value outside of these, and for ``rewarded="last"`` with ``K=None``
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "switching_convention_v0", "render_modes": [], "is_parallelizable": True}
    render_mode = None

    def __init__(
        self,
        m: int = 4,
        K: int | None = 5,
        rollout_steps: int = 16,
        rewarded: str = "always",
        leader_visible: bool = True,
        seed: int = 0,
    ):
        self.config = ConventionConfig(m, K, rollout_steps, rewarded, leader_visible, seed)
        self.game = ConventionGame(1, self.config)
        self.possible_agents = [FOLLOWER]
        self.agents: list[str] = []
        self.observation_spaces: dict[str, spaces.Space] = {FOLLOWER: spaces.Discrete(m)}
        self.action_spaces: dict[str, spaces.Space] = {FOLLOWER: spaces.Discrete(m)}
        self.scripted_action_spaces: dict[str, spaces.Space] = {LEADER: spaces.Discrete(m)}

    @property
    def convention(self) -> np.ndarray:
        """
        :return: int64 [m], what the leader plays at each cue, in the next step
        """
        return self.game.conventions[0].copy()

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, int], dict[str, dict[str, Any]]]:
        """
        :param seed: of the cues; the environment's life begins anew, with its first convention. None: both go on
        :param options: not used
        :return: the first cue and an empty info, by agent
        """
        if seed is not None:
            self.game.seed(0, seed)
        self.game.reset()
        self.agents = [FOLLOWER]
        return {FOLLOWER: int(self.game.cue[0])}, {FOLLOWER: {}}

    def step(
        self, actions: dict[str, int]
    ) -> tuple[dict[str, int], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """
        :param actions: the follower's action, in [0, m)
        :return: next cue, reward, termination (True at the last step of an episode), truncation (False) and an empty info, by
            agent
        :raises ValueError: if the action is missing or there is no such action, or if no episode is under way
        """
        self._require_episode()
        if FOLLOWER not in actions:
            raise ValueError(f"No action for {FOLLOWER!r}, the one who acts here; got actions for {list(actions)}.")
        action = actions[FOLLOWER]
        if action not in range(self.config.m):
            raise ValueError(f"The action of {FOLLOWER!r} is {action!r}; allowed are the integers 0 to {self.config.m - 1}.")
        rewards, dones = self.game.step(np.array([action]))
        done = bool(dones[0])
        if done:
            self.agents = []
        obs, reward = {FOLLOWER: int(self.game.cue[0])}, {FOLLOWER: float(rewards[0])}
        return obs, reward, {FOLLOWER: done}, {FOLLOWER: False}, {FOLLOWER: {}}

    def scripted_actions(self) -> dict[str, int]:
        """
        :return: what the leader did in the last step, at the cue that the follower saw before it
        """
        return {LEADER: int(self.game.leader[0])}

    def visibility(self) -> dict[str, np.ndarray]:
        """
        :return: bool [1]: whether the follower is told what the leader did in the last step
        """
        return {FOLLOWER: np.array([self.config.leader_visible])}

    def get_state(self) -> dict[str, Any]:
        """
        :return: all that decides how the episode and those after it go on, as arrays and plain data
        """
        return {"game": self.game.get_state(0), "under_way": bool(self.agents)}

    def set_state(self, state: dict[str, Any]) -> None:
        """
        Go on where ``get_state`` was called; given the same actions, everything that follows is the same bit for bit.

        :param state: what ``get_state`` returned in an environment with the same arguments
        :raises ValueError: if the arguments differ
        """
        self.game.set_state(0, state["game"])
        self.agents = [FOLLOWER] if state["under_way"] else []
