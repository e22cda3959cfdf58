"""The history: which steps it holds, and when it changes."""

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_belief.belief import filled_rows
from sb3_belief.belief_ppo import BeliefPPO
from tests.belief_ppo.helpers import ALGORITHMS, ROLLOUT, SMALL, VARIANTS, Watch, make_model
from tests.belief_ppo.toy_envs import AmongOthers


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_history_is_the_last_active_steps_of_the_rollout_before(algorithm):
    model = make_model(algorithm=algorithm, env_kwargs=dict(inactive=4))
    rollouts, during = [], []

    def look(model):
        buffer = model.rollout_buffer
        rollouts.append([buffer.observations.copy(), buffer.others_actions.copy(), buffer.active.copy()])
        during.append(model.policy.history)

    class AfterUpdate(BaseCallback):
        def _on_step(self):
            return True

        def _on_rollout_start(self):
            after.append(model.policy.history)

    after = []
    model.learn(4 * ROLLOUT, callback=[Watch(look), AfterUpdate()])
    after.append(model.policy.history)
    expected_obs, expected_actions = [], []
    assert not after[0].valid.any()
    for (observations, actions, active), before, afterwards, seen in zip(rollouts, after[:-1], after[1:], during, strict=True):
        for old, new in zip(before, seen, strict=True):
            assert th.equal(old, new)  # frozen during the rollout: it cannot hold a row of it
        for step in range(14):
            for env in range(3):
                if active[step, env]:
                    expected_obs.append(observations[step, env])
                    expected_actions.append(actions[step, env])
        n_rows = min(40, len(expected_obs))
        np.testing.assert_array_equal(filled_rows(afterwards).observations.numpy(), np.stack(expected_obs[-n_rows:]))
        np.testing.assert_array_equal(filled_rows(afterwards).actions.numpy(), np.stack(expected_actions[-n_rows:]))
    assert 0 < active.sum() < active.size and n_rows == 40


def test_history_is_frozen_during_the_update():
    model = make_model()
    model.learn(ROLLOUT)
    before, seen = [part.clone() for part in model.policy.history], []
    update = model._update

    def watched_update():
        update()
        seen.append([part.clone() for part in model.policy.history])

    model._update = watched_update
    model.learn(ROLLOUT)
    assert len(seen) == 1 and all(th.equal(a, b) for a, b in zip(before, seen[0], strict=True))
    assert not th.equal(model.policy.history.observations, before[0])


@pytest.mark.parametrize("belief", [*VARIANTS, "none"])
def test_only_a_belief_that_attends_has_a_history(belief):
    policy = make_model(belief=belief).learn(ROLLOUT).policy
    attends = belief in ("dynamic", "context", "adaptive")
    assert (policy.history is not None) == attends
    assert any("history" in name for name in policy.state_dict()) == attends
    # An adaptive belief keeps no steps at which nobody was seen
    filled = policy.history is not None and (
        policy.history.valid.any() if belief == "adaptive" else policy.history.valid.all()
    )
    assert filled == attends


def test_a_history_longer_than_the_training_is_partly_filled():
    model = make_model(history_length=1000, keep_ratio=0.1)
    model.learn(ROLLOUT)
    assert model.policy.history.valid.sum() == ROLLOUT
    model.learn(ROLLOUT)
    assert model.policy.history.valid.sum() == 2 * ROLLOUT
    # N_h grows with it: a share of the rows there are, not of those there may be
    assert model.rollout_buffer.belief_minibatch(slice(None)).selected.shape[-1] == round(0.1 * ROLLOUT)


def test_with_normalised_observations_the_history_holds_what_the_policy_saw():
    env = VecNormalize(make_vec_env(AmongOthers, n_envs=3, seed=0, env_kwargs=dict(inactive=4)))
    model = BeliefPPO("BeliefPolicy", env, **SMALL)
    seen = []
    model.learn(3 * ROLLOUT, callback=Watch(lambda model: seen.append(model.rollout_buffer.observations.copy())))
    assert model.logger.name_to_value["belief/first_log_ratio"] < 1e-5
    assert model.policy.history is not None
    rows = {row.tobytes() for rollout in seen for row in rollout.reshape(-1, 5)}
    history = model.policy.history.observations.numpy()
    assert len(history) == 40 and all(row.tobytes() in rows for row in history)
    assert np.abs(history).max() > 1  # not the raw observations, which are within [-1, 1]
