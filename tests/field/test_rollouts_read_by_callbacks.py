"""A callback may read the finished rollout through ``rollout_buffer.get()``, as it may with SB3's algorithms."""

from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback

from tests.belief_ppo.helpers import EVERY, make_model, same_parameters


class Reads(BaseCallback):
    """Reads all minibatches of each rollout, or only draws the random numbers that this takes."""

    model: Any

    def __init__(self, batch_size, reads):
        super().__init__()
        self.batch_size, self.reads, self.n_rows = batch_size, reads, 0

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        buffer = self.model.rollout_buffer
        if self.reads:
            self.n_rows += sum(len(samples.actions) for samples in buffer.get(self.batch_size))
        else:
            np.random.permutation(buffer.buffer_size * buffer.n_envs)


@pytest.mark.parametrize("batch_size", [None, 8])
@pytest.mark.parametrize("algorithm, belief", EVERY)
def test_reading_a_rollout_changes_nothing(algorithm, belief, batch_size):
    models, callbacks = [], [Reads(batch_size, reads) for reads in (True, False)]
    for callback in callbacks:
        model = make_model(env_kwargs=dict(inactive=3), algorithm=algorithm, belief=belief)
        models.append(model.learn(3 * 42, callback=callback))
    assert callbacks[0].n_rows > 60
    assert same_parameters(*models)
    first, second = (model.logger.name_to_value for model in models)
    assert {name: value for name, value in first.items() if not name.startswith("time/")} == {
        name: value for name, value in second.items() if not name.startswith("time/")
    }
    if models[0].policy.history is not None:
        for ours, theirs in zip(models[0].policy.history, models[1].policy.history, strict=True):
            assert bool((ours == theirs).all())
