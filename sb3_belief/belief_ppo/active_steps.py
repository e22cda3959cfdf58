"""
What an on-policy algorithm needs to leave out the steps in which its agent was not in play.

What the environment says of a step comes by way of ``_update_info_buffer``, which SB3 calls once a step just before ``add``.
"""

from collections.abc import Generator
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.utils import explained_variance
from stable_baselines3.common.vec_env import VecNormalize

from sb3_belief.belief_ppo.cut_returns import CutReturns

if TYPE_CHECKING:
    _Buffer = RolloutBuffer
    _Algorithm = OnPolicyAlgorithm
else:
    _Buffer = _Algorithm = object


class ActiveStepsBufferMixin(_Buffer):
    """Makes a rollout buffer of SB3's one without the steps in which the agent was not in play."""

    #: Arrays of a row for each step besides those of SB3
    extras: ClassVar[tuple[str, ...]] = ("active",)

    #: Whether the agent was in play when it acted
    active: np.ndarray

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._cut_returns = CutReturns(self.n_envs, self.gamma)

    def reset(self) -> None:
        super().reset()
        self.active = np.ones((self.buffer_size, self.n_envs), dtype=bool)
        # Whether it is in play at the observation after the last step
        self._next_active = np.ones(self.n_envs, dtype=bool)

    def stage(self, active: np.ndarray, next_active: np.ndarray | None = None) -> None:
        """
        Write what the environment says of a step into the row that ``add`` fills next.

        :param active: Whether the agent was in play when it acted, bool ``[n_envs]``
        :param next_active: Whether it is in play after the step, bool ``[n_envs]``; None if that is as in the step
        """
        self.active[self.pos] = active
        self._next_active[:] = active if next_active is None else next_active

    def compute_returns_and_advantage(self, last_values: th.Tensor, dones: np.ndarray) -> None:
        """
        Compute returns as SB3 does, except that the critic has no opinion of inactive steps, on which it is never trained.

        The value of an inactive step is what it went on to earn. If the rollout ends while the agent is out of play, this is
        not known, and :class:`~sb3_belief.belief_ppo.cut_returns.CutReturns` estimates the return of its last active step.

        :param last_values: Values of the observations after the last step, ``[n_envs]``
        :param dones: Whether the agent's return ended with the last step, ``[n_envs]``
        """
        dones = np.asarray(dones, dtype=bool)
        starts = self.episode_starts.astype(bool)
        away = ~dones & ~self._next_active
        if self.active.all() and not away.any():
            self._cut_returns.forget()
            return super().compute_returns_and_advantage(last_values, dones)
        ends = np.concatenate([starts[1:], dones[None]])
        steps, copies, expected = self._cut_returns.estimate(self.rewards, self.values, self.active, starts, ends, away)
        next_values = last_values.clone().cpu().numpy().flatten()
        for step in reversed(range(self.buffer_size)):
            earned = self.rewards[step] + self.gamma * ~ends[step] * next_values
            self.values[step] = np.where(self.active[step], self.values[step], earned)
            next_values = self.values[step]
        # As if the agent had been paid the expected return there, at the end of an episode
        rewards, self.rewards = self.rewards, self.rewards.copy()
        self.rewards[steps, copies], ends[steps, copies] = expected, True
        self.episode_starts[1:] = ends[:-1]
        super().compute_returns_and_advantage(last_values, ends[-1])
        self.rewards, self.episode_starts[1:] = rewards, starts[1:]

    def active_steps(self) -> np.ndarray:
        """
        Return the numbers of the active steps, counted through all copies at each time.

        :return: int ``[N]``, ascending: step t of copy e has the number ``t * n_envs + e``
        """
        numbers = np.arange(self.buffer_size * self.n_envs)
        return numbers[self.active[self.rows_of(numbers)]]

    def rows_of(self, steps: np.ndarray) -> tuple[np.ndarray, ...]:
        """
        Return where steps lie in the arrays at present. The first :meth:`get` after a rollout, which may be a callback's, puts
        the copies one after the other.

        :param steps: Numbers of steps, see :meth:`active_steps`
        :return: Index into the first one or two dimensions of the arrays
        """
        times, copies = np.divmod(steps, self.n_envs)
        return (copies * self.buffer_size + times,) if self.generator_ready else (times, copies)

    def get(self, batch_size: int | None = None) -> Generator[Any, None, None]:
        """
        Yield minibatches as SB3 does, without any inactive step.

        :param batch_size: Rows of a minibatch, before inactive steps are left out of it; None for all at once
        :return: The minibatches. If less than two rows are left of one, they go with the next: a single row has no advantage
            statistics (sb3-contrib would divide by nothing)
        """
        if not self.generator_ready:
            for name in self.extras:
                array = getattr(self, name)
                setattr(self, name, array.swapaxes(0, 1).reshape(self.active.size, *array.shape[2:]))
        leaves_out = not self.active.all()
        left_over = np.zeros(0, dtype=int)
        indices: Generator[Any, None, None] = super().get(batch_size)
        for rows in indices:
            if leaves_out:
                rows = np.concatenate([left_over, rows[self.active[rows]]])
                left_over = rows[:0]
                if len(rows) < 2:
                    left_over = rows
                    continue
            yield self._samples(rows)

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> Any:
        # SB3's get() shuffles and cuts; which rows of a minibatch are used is decided in ours
        return batch_inds

    def _samples(self, rows: np.ndarray) -> Any:
        return super()._get_samples(rows)


class ActiveStepsAlgorithmMixin(_Algorithm):
    """
    Makes an on-policy algorithm of SB3's one that leaves out the steps in which its agent was not in play.

    Its rollout buffer is one of :class:`ActiveStepsBufferMixin`. No method of SB3 is copied.
    """

    rollout_buffer: ActiveStepsBufferMixin
    normalize_advantage: bool
    #: Whether inactive steps are left out. False trains on all that SB3 would train on
    active_masks: bool = True

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: np.ndarray | None = None) -> None:
        # SB3 calls this once a step, after the callbacks and before it bootstraps time limits and adds the step to the buffer
        super()._update_info_buffer(infos, dones)
        # SB3 accepts environments that return fewer infos than copies
        active, next_active = np.ones((2, self.n_envs), dtype=bool)
        if not self.active_masks:
            self.rollout_buffer.stage(active, next_active)
            return
        active[: len(infos)] = [info.get("active", True) for info in infos]
        # An environment that does not say who plays next is taken to go on as it is
        next_active[: len(infos)] = [info.get("next_active", info.get("active", True)) for info in infos]
        if dones is not None and dones.any():
            for copy in np.flatnonzero(dones[: len(infos)] & ~next_active[: len(infos)]):
                # The critic has no opinion of an agent that is out of play at the limit
                infos[copy]["TimeLimit.truncated"] = False
        self.rollout_buffer.stage(active, next_active)

    @property
    def _learns(self) -> bool:
        """Whether a rollout can be trained on: the advantages of a single step cannot be normalised."""
        active = self.rollout_buffer.active
        return bool(active.sum() > 1 or (active.all() and not self.normalize_advantage))

    def train(self) -> None:
        """Update as SB3 does, without the inactive steps; not at all if the agent was hardly ever in play."""
        if self._learns:
            self._update()

    def _update(self) -> None:
        super().train()
        # SB3 computes it over all steps, including those in which the agent was not in play and no value is trained
        active, values, returns = (getattr(self.rollout_buffer, name).flatten() for name in ("active", "values", "returns"))
        self.logger.record("train/explained_variance", explained_variance(values[active], returns[active]))
