"""What a belief that predicts more than the present step is trained on."""

from typing import Any

import numpy as np


def seen_later(buffer: Any, rows: Any, n_later: int) -> tuple[np.ndarray, np.ndarray]:
    """
    Return what an agent saw of the others in the steps after those of some rows.

    :param buffer: Its rollout, a buffer of :mod:`sb3_belief.belief_ppo.buffers`
    :param rows: Index into the ``B`` rows as they are ordered at present
    :param n_later: ``k``, how many steps after each, at least 1
    :return: The others' actions, float32 ``[B, k, W]``, and who was visible, bool ``[B, k, n_others]``: nobody after the
        agent's return or the rollout has ended
    """
    numbers = np.arange(buffer.active.size).reshape(buffer.active.shape)[rows]
    if buffer.generator_ready:
        copies, times = np.divmod(numbers, buffer.buffer_size)
    else:
        times, copies = np.divmod(numbers, buffer.n_envs)
    # A return that starts in between has another number
    returns = buffer.episode_starts.astype(int).cumsum(axis=0)
    actions, visible = [], []
    for later in range(1, n_later + 1):
        then = np.minimum(times + later, buffer.buffer_size - 1)
        at = buffer.rows_of(then * buffer.n_envs + copies)
        goes_on = (times + later < buffer.buffer_size) & (returns[then, copies] == returns[times, copies])
        visible.append(buffer.others_visible[at] & goes_on[..., None])
        actions.append(buffer.others_actions[at])
    return np.stack(actions, axis=-2), np.stack(visible, axis=-2)
