"""What to expect of a return that the end of a rollout cuts off while the agent is out of play."""

import numpy as np

# What a rollout has shown counts this much after each later one, since it changes with policy and critic
_DECAY = 0.9


class CutReturns:
    """
    Estimates returns that the end of a rollout cuts off while the agent is out of play.

    Such an agent is dead, with the team's reward still to come, or not on turn. What it goes on to earn is unknown, and a
    critic that is trained on active steps has no opinion of it. The estimate is the critic's value of the agent's last active
    step, plus what the returns of earlier absences turned out to differ from that value, on average over all steps of
    absence: a rollout ends at each of them with equal chance. So it is right on average, whatever an absence costs.

    :param n_envs: Number of copies of the environment
    :param gamma: Discount factor
    """

    def __init__(self, n_envs: int, gamma: float):
        self._gamma = gamma
        # Sums over steps of absences that have ended: of the difference, and of ones
        self._difference = self._n_steps = 0.0
        # Of each copy: whether its present return has had an active step, and of the last of these the row in this rollout (-1
        # for an earlier one), its value, what has been earned from it on, the discount since, and the steps of absence
        self._has_acted = np.zeros(n_envs, dtype=bool)
        self._row, self._length = np.full(n_envs, -1), np.zeros(n_envs, dtype=int)
        self._value, self._earned, self._discount = np.zeros(n_envs), np.zeros(n_envs), np.ones(n_envs)

    def forget(self) -> None:
        """Forget the absences that last, but not what earlier ones have shown."""
        self._has_acted[:] = False

    def estimate(
        self,
        rewards: np.ndarray,
        values: np.ndarray,
        active: np.ndarray,
        starts: np.ndarray,
        ends: np.ndarray,
        away: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """
        Estimate the cut returns of a rollout, which follows the one of the last call. Arrays are ``[n_steps, n_envs]``.

        :param rewards: The agent's rewards
        :param values: The critic's values, used where the agent is active
        :param active: Whether it was in play, bool
        :param starts: Whether a return starts with the step, bool
        :param ends: Whether one ends after the step, bool
        :param away: Whether the agent is out of play when the rollout ends, bool ``[n_envs]``
        :return: Rows and copies of the last active steps before the cuts, and the estimated returns from them on
        """
        self._difference *= _DECAY
        self._n_steps *= _DECAY
        self._row[:] = -1
        for row in range(len(rewards)):
            played = active[row]
            self._observe(self._is_absent() & played & ~starts[row], self._earned + self._discount * values[row])
            self._has_acted = played | (self._has_acted & ~starts[row])
            self._row[played] = row
            self._value = np.where(played, values[row], self._value)
            self._earned = np.where(played, 0.0, self._earned) + np.where(played, 1.0, self._discount) * rewards[row]
            self._discount = np.where(played, self._gamma, self._discount * self._gamma)
            self._length = np.where(played, 0, self._length + 1)
            self._observe(self._is_absent() & ends[row], self._earned)
            self._has_acted &= ~ends[row]
        copies = np.flatnonzero(away & self._has_acted & (self._row >= 0))
        rows = self._row[copies]
        mean = self._difference / self._n_steps if self._n_steps else 0.0
        return rows, copies, values[rows, copies] + mean

    def _is_absent(self) -> np.ndarray:
        return self._has_acted & (self._length > 0)

    def _observe(self, over: np.ndarray, returns: np.ndarray) -> None:
        """Take in the returns of the absences that are over, in the copies where ``over`` says so."""
        self._difference += float(((returns - self._value) * self._length)[over].sum())
        self._n_steps += float(self._length[over].sum())
