"""Listeners without training, which show what a memory of one's own rewards is worth with a foreign speaker."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sb3_belief.envs.foreign_speaker.parallel_env import LISTENER
from sb3_belief.envs.reference_policies import ReferencePolicy
from sb3_belief.vec_env.team_vec_env import TeamObs

_STEPS, _LANDMARKS = 25, 3
# mpe2's physics: seconds of a step, share of the velocity that remains after it, and what an action adds to it
_DT, _KEPT, _PUSH = 0.1, 0.75, 0.5
# No language is longer than 8 episodes by default; the same number tells a memory when to forget
_EPISODES = 8


def steer(velocity: np.ndarray, target: np.ndarray, left: int) -> int:
    """
    Return the action after which the listener comes to rest as near to a target as can be, if it does nothing more.

    :param velocity: Velocity of the listener [2]
    :param target: Position of the target relative to it [2]
    :param left: Number of steps to the end of the episode, this one included
    :return: Nothing 0, left 1, right 2, down 3 or up 4
    """
    # With a velocity v the way of k steps is v * (1 + KEPT + ... + KEPT^(k-1)) * DT, and a push moves from the next step on
    miss = target - velocity * _DT * (1 - _KEPT**left) / (1 - _KEPT)
    reach = _PUSH * _DT * (1 - _KEPT ** (left - 1)) / (1 - _KEPT)
    axis = int(np.abs(miss).argmax())
    if abs(miss[axis]) < reach / 2:
        return 0
    return 1 + 2 * axis + int(miss[axis] > 0)


class _Listener(ReferencePolicy):
    """
    Listener that goes to the middle of the landmarks that may be the goal.

    :param n_envs: Number of environment copies
    """

    def __init__(self, n_envs: int):
        self.time = np.zeros(n_envs, dtype=np.int64)

    def candidates(self, copy: int, heard: int, partner: str) -> Sequence[int]:
        """
        Return which landmarks may be the goal.

        :param copy: The copy
        :param heard: The symbol
        :param partner: The language
        """
        return range(_LANDMARKS)

    def act(self, obs: TeamObs, partners: list[str]) -> TeamObs:
        """
        Steer to the middle of the candidates.

        :param obs: Observations [n_envs, 11] of the listener
        :param partners: Language of each copy
        :return: Actions [n_envs]
        """
        actions = []
        for copy, (row, partner) in enumerate(zip(obs[LISTENER], partners, strict=True)):
            marks, speech = row[2:8].reshape(_LANDMARKS, 2), row[8:11]
            candidates = self.candidates(copy, int(speech.argmax()), partner) if speech.any() else range(_LANDMARKS)
            actions.append(steer(row[:2], marks[list(candidates)].mean(axis=0), _STEPS - int(self.time[copy])))
        return {LISTENER: np.array(actions)}

    def watch(self, obs: TeamObs, rewards: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
        """
        Count the steps of the episode.

        :param obs: Not used
        :param rewards: Not used
        :param dones: Where an episode has ended, bool [n_envs]
        :param infos: Not used
        """
        self.time = np.where(dones, 0, self.time + 1)


class BlindListener(_Listener):
    """Listener without a memory, for which the middle of all landmarks is best."""


class KnowingListener(_Listener):
    """Listener that is told the language."""

    def candidates(self, copy: int, heard: int, partner: str) -> Sequence[int]:
        """
        Return the goal.

        :param copy: Not used
        :param heard: The symbol
        :param partner: The language
        """
        return (partner.split("-").index(str(heard)),)


class RememberingListener(_Listener):
    """
    Listener with an ideal memory of its own rewards. A reward at the end says how far the goal was, so which landmark it was,
    and a symbol keeps its meaning for some episodes.

    :param n_envs: Number of environment copies
    :param episodes: Number of episodes for which a language stays
    :param guesses: Whether it goes to one of the candidates at random instead of their middle, which costs more
    :param seed: Seed of the guesses
    """

    def __init__(self, n_envs: int, episodes: int = _EPISODES, guesses: bool = False, seed: int = 0):
        super().__init__(n_envs)
        self.episodes, self.guesses = episodes, guesses
        self.generator = np.random.default_rng(seed)
        self.played = np.zeros(n_envs, dtype=np.int64)
        self.known: list[dict[int, int]] = [{} for _ in range(n_envs)]
        self.guess: list[int | None] = [None] * n_envs

    def candidates(self, copy: int, heard: int, partner: str) -> Sequence[int]:
        """
        Return the landmark that the symbol is known to mean, or those that no other symbol means.

        :param copy: The copy
        :param heard: The symbol
        :param partner: Not used
        """
        known = self.known[copy]
        if heard in known:
            return (known[heard],)
        free = [mark for mark in range(_LANDMARKS) if mark not in known.values()]
        if not self.guesses:
            return free
        if self.guess[copy] is None:
            self.guess[copy] = int(self.generator.choice(free))
        return (self.guess[copy],)  # type: ignore[return-value]

    def watch(self, obs: TeamObs, rewards: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
        """
        Learn what the symbol of an episode meant, and forget it with its language.

        :param obs: Observations before the step
        :param rewards: Rewards of the step
        :param dones: Where an episode has ended, bool [n_envs]
        :param infos: Infos of the step
        """
        super().watch(obs, rewards, dones, infos)
        for copy in np.flatnonzero(dones):
            last = infos[copy]["terminal_observation"][LISTENER]
            distances = np.square(last[2:8].reshape(_LANDMARKS, 2)).sum(axis=1)
            self.known[copy][int(last[8:11].argmax())] = int(np.abs(_STEPS * distances + rewards[copy]).argmin())
            self.guess[copy] = None
            self.played[copy] += 1
            if self.played[copy] % self.episodes == 0:
                self.known[copy] = {}
