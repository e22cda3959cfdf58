"""
Rollout buffers that also hold what a belief is trained on, and leave out the steps in which the agent was not in play.

SB3 fills its buffer inside `collect_rollouts`, which has no place for more. But `_update_info_buffer` is called once a
step, just before `add`: there the algorithm stages the rest of the row with :meth:`BeliefBufferMixin.stage`.
"""

from collections.abc import Callable, Generator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer
from stable_baselines3.common.vec_env import VecNormalize


class BeliefMinibatch(NamedTuple):
    """
    What a minibatch holds beyond SB3's samples; ``B`` rows, in the same order.

    :param noise: The noise of eq. 5 with which the agent acted, ``[B, z]``; of width 0 for a belief that does not sample
    :param kept: The history rows it attended to, ``[B, N_h]``; of width 0 for a belief without a history
    :param others_actions: ``[B, W]``, zero where not visible
    :param others_visible: bool ``[B, n_others]``
    """

    noise: th.Tensor
    kept: th.Tensor
    others_actions: th.Tensor
    others_visible: th.Tensor


if TYPE_CHECKING:
    _Buffer = RolloutBuffer
else:
    _Buffer = object

_EXTRAS = ("noise", "kept", "others_actions", "others_visible", "active")


class BeliefBufferMixin(_Buffer):
    """
    :param noise_dim: ``z``, 0 where no belief is sampled
    :param history_kept: The most history rows that are attended to, ``N_h``, 0 where none are
    :param others_width: ``W``, 0 without a belief
    :param n_others: Number of others, 0 without a belief
    """

    noise: np.ndarray
    kept: np.ndarray
    others_actions: np.ndarray
    others_visible: np.ndarray
    active: np.ndarray

    def __init__(
        self,
        *args: Any,
        noise_dim: int = 0,
        max_selected: int = 0,
        others_width: int = 0,
        n_others: int = 0,
        **kwargs: Any,
    ) -> None:
        # Before SB3's constructor, which calls reset()
        self._widths = dict(noise=noise_dim, kept=max_selected, others_actions=others_width, others_visible=n_others)
        #: Told of every minibatch before SB3 gets its part of it
        self.on_minibatch: Callable[[BeliefMinibatch], None] | None = None
        super().__init__(*args, **kwargs)

    def reset(self) -> None:
        super().reset()
        rows = self.buffer_size, self.n_envs
        self.noise = np.zeros((*rows, self._widths["noise"]), dtype=np.float32)
        self.kept = np.zeros((*rows, self._widths["kept"]), dtype=np.int32)
        self.others_actions = np.zeros((*rows, self._widths["others_actions"]), dtype=np.float32)
        self.others_visible = np.zeros((*rows, self._widths["others_visible"]), dtype=bool)
        self.active = np.ones(rows, dtype=bool)
        #: Rows attended to are as many in every step of a rollout, but grow with the history from one to the next
        self._n_selected = 0

    def stage(self, active: np.ndarray, minibatch: BeliefMinibatch | None = None) -> None:
        """
        Write what SB3's ``add`` does not know into the row that it will fill next.

        :param active: Whether the agent was in play when it acted, bool ``[n_envs]``
        :param minibatch: The belief's part of the step, ``n_envs`` rows; None without a belief
        """
        self.active[self.pos] = active
        if minibatch is None:
            return
        self._n_selected = minibatch.kept.shape[1]
        self.noise[self.pos] = minibatch.noise.cpu().numpy()
        self.kept[self.pos, :, : self._n_selected] = minibatch.kept.cpu().numpy()
        self.others_actions[self.pos] = minibatch.others_actions.numpy()
        self.others_visible[self.pos] = minibatch.others_visible.numpy()

    def compute_returns_and_advantage(self, last_values: th.Tensor, dones: np.ndarray) -> None:
        """
        As SB3's, except that the value of an inactive step is what it went on to earn: the critic is never trained there,
        so its opinion must not enter the advantage of the steps before.

        :param last_values: Values of the observations after the last step, ``[n_envs]``
        :param dones: Whether the agent's return ended with the last step, ``[n_envs]``
        """
        if not self.active.all():
            next_values, goes_on = last_values.clone().cpu().numpy().flatten(), 1.0 - dones.astype(np.float32)
            for step in reversed(range(self.buffer_size)):
                earned = self.rewards[step] + self.gamma * goes_on * next_values
                self.values[step] = np.where(self.active[step], self.values[step], earned)
                next_values, goes_on = self.values[step], 1.0 - self.episode_starts[step]
        super().compute_returns_and_advantage(last_values, dones)

    def recent(self, n_rows: int) -> tuple[np.ndarray | dict[str, np.ndarray], np.ndarray]:
        """
        The last active steps of all env copies, interleaved by time. Must be called before :meth:`get`, which reorders.

        :param n_rows: The most rows to return
        :return: The observations of these steps and the others' actions, oldest first
        """
        if self.generator_ready:
            raise RuntimeError("recent() must be called before the first get() of an update: that reorders the rows")
        rows = np.flatnonzero(self.active.reshape(-1))[-n_rows:]

        def pick(array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
            # As the environment gives them: SB3 keeps a Discrete observation as an array of one number
            return array.reshape(-1, *array.shape[2:])[rows].reshape(len(rows), *shape)

        actions = pick(self.others_actions, self.others_actions.shape[2:])
        observations, space = self.observations, self.observation_space
        if isinstance(observations, dict) and isinstance(space, spaces.Dict):
            return {key: pick(part, space[key].shape or ()) for key, part in observations.items()}, actions
        return pick(observations, space.shape or ()), actions

    def get(self, batch_size: int | None = None) -> Generator[Any, None, None]:
        """
        :param batch_size: Rows of a minibatch, before inactive steps are left out of it; None for all at once
        :return: Minibatches as SB3 yields them, without any inactive step; what is left of one then, if less than two rows,
            goes with the next
        """
        if not self.generator_ready:
            for name in _EXTRAS:
                array = getattr(self, name)
                setattr(self, name, array.swapaxes(0, 1).reshape(self.active.size, *array.shape[2:]))
        self._held = np.zeros(0, dtype=int)
        yield from (samples for samples in super().get(batch_size) if samples is not None)

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> Any:
        if not self.active.all():
            batch_inds = np.concatenate([self._held, batch_inds[self.active[batch_inds]]])
            # A single row has no advantage statistics (sb3-contrib would divide by nothing): it goes with the next minibatch
            if len(batch_inds) < 2:
                self._held = batch_inds
                return None
            self._held = batch_inds[:0]
        if self.on_minibatch is not None:
            self.on_minibatch(self.belief_minibatch(batch_inds))
        return super()._get_samples(batch_inds, env)

    def belief_minibatch(self, rows: Any) -> BeliefMinibatch:
        """
        :param rows: Index into the rows as they are ordered at present
        :return: The belief's part of these rows, on the buffer's device; for a slice it is a part of the buffer itself
        """
        parts = (
            self.noise[rows],
            self.kept[rows][..., : self._n_selected],
            self.others_actions[rows],
            self.others_visible[rows],
        )
        return BeliefMinibatch(*(self.to_torch(part, copy=False) for part in parts))


class BeliefRolloutBuffer(BeliefBufferMixin, RolloutBuffer):
    """SB3's rollout buffer with the belief's part of each step, see :class:`BeliefBufferMixin`."""


class BeliefDictRolloutBuffer(BeliefBufferMixin, DictRolloutBuffer):
    """The same for Dict observations."""
