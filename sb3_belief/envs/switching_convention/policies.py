"""Followers without training in the convention game, and the return of the best possible one."""

from typing import Any

import numpy as np

from sb3_belief.envs.reference_policies import ReferencePolicy
from sb3_belief.envs.switching_convention.parallel_env import FOLLOWER
from sb3_belief.vec_env.team_vec_env import TeamObs


class KnowingFollower(ReferencePolicy):
    """Follower that is told the convention. Its return is the length of the episode."""

    def act(self, obs: TeamObs, partners: list[str]) -> TeamObs:
        """
        Do what the leader does at the cue.

        :param obs: Cues [n_envs] of the follower
        :param partners: Convention of each copy, as the environment names it
        :return: Its actions [n_envs]
        """
        played = [int(partner.split("-")[cue]) for cue, partner in zip(obs[FOLLOWER], partners, strict=True)]
        return {FOLLOWER: np.array(played)}


class BlindFollower(ReferencePolicy):
    """Follower that always does the same. Nobody without a memory does better, 1/m of the length of the episode."""

    def act(self, obs: TeamObs, partners: list[str]) -> TeamObs:
        """
        Do action 0.

        :param obs: Cues [n_envs] of the follower
        :param partners: Not used
        :return: Its actions [n_envs]
        """
        return {FOLLOWER: np.zeros(len(obs[FOLLOWER]), dtype=np.int64)}


class RememberingFollower(ReferencePolicy):
    """
    Follower with an ideal memory of its episode: at a cue that it has met it does what the leader did there, and at another
    one any action that the leader has not taken at any cue, since a convention is a permutation.

    :param n_envs: Number of environment copies
    :param m: Number of cues
    :param seed: Seed of its guesses
    """

    def __init__(self, n_envs: int, m: int = 4, seed: int = 0):
        self.known = np.full((n_envs, m), -1, dtype=np.int64)
        self.generator = np.random.default_rng(seed)

    def act(self, obs: TeamObs, partners: list[str]) -> TeamObs:
        """
        Do what the leader is known to do at the cue, or guess.

        :param obs: Cues [n_envs] of the follower
        :param partners: Not used
        :return: Its actions [n_envs]
        """
        actions = self.known[np.arange(len(self.known)), obs[FOLLOWER]]
        for copy in np.flatnonzero(actions < 0):
            actions[copy] = self.generator.choice(np.setdiff1d(np.arange(self.known.shape[1]), self.known[copy]))
        return {FOLLOWER: actions}

    def watch(self, obs: TeamObs, rewards: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
        """
        Remember what the leader did, and forget it where the episode has ended.

        :param obs: The cues at which it did so
        :param rewards: Not used
        :param dones: Where an episode has ended, bool [n_envs]
        :param infos: Infos of the step, with the leader's action
        """
        played = [int(info["scripted_actions"].argmax()) for info in infos]
        self.known[np.arange(len(self.known)), obs[FOLLOWER]] = played
        self.known[dones] = -1


def ideal_convention_return(m: int = 4, steps: int = 64) -> float:
    """
    Return what :class:`RememberingFollower` gets in an episode, which is the most that anybody can who is not told.

    With j cues met, the next one is among them with probability j/m, and otherwise a guess among the m - j actions that are
    left is right with probability 1/(m - j). So the expected reward is (j + 1)/m, and 1 as soon as m - 1 cues are known.

    :param m: Number of cues
    :param steps: Steps of the episode
    :return: The expected return
    """
    met = np.zeros(m + 1)
    met[0] = 1.0
    share = np.arange(m + 1) / m
    total = 0.0
    for _ in range(steps):
        total += float(met @ np.minimum(share + 1 / m, 1.0))
        met = met * share + np.concatenate([[0.0], (met * (1 - share))[:-1]])
    return total
