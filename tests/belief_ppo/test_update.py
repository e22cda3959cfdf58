"""The update begins with the policy that acted, and trains what it should."""

from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import obs_as_tensor

from sb3_belief.belief_ppo.buffers import attach, attached
from tests.belief_ppo.helpers import ALGORITHMS, ROLLOUT, VARIANTS, Watch, make_model, record_beliefs

BOX = spaces.Box(-1, 1, (2,), np.float32)


def log_ratios(model: Any, n_iterations: int) -> list[tuple[int, int, float]]:
    """Of each minibatch: number of updates before, its number in the epoch, and the largest |log ratio| of its rows."""
    ratios: list[tuple[int, int, float]] = []
    evaluate, get = model.policy.evaluate_actions, model.rollout_buffer.get
    at_hand: list[Any] = []

    def recorded_get(batch_size):
        for index, samples in enumerate(get(batch_size)):
            at_hand[:] = [model._n_updates, index, samples.old_log_prob]
            yield samples

    def recorded_evaluate(obs, actions, **kwargs):
        values, log_prob, entropy = evaluate(obs, actions, **kwargs)
        if log_prob.requires_grad:  # not the diagnostics before the update
            n_updates, index, old = at_hand
            ratios.append((n_updates, index, float((log_prob.detach() - old).abs().max())))
        return values, log_prob, entropy

    model.rollout_buffer.get, model.policy.evaluate_actions = recorded_get, recorded_evaluate
    model.learn(n_iterations * ROLLOUT, callback=Watch(lambda model: None))
    return ratios


def check_log_ratios(model: Any, n_iterations: int) -> None:
    ratios = log_ratios(model, n_iterations)
    first = [ratio for n_updates, index, ratio in ratios if n_updates % 2 == 0 and index == 0]
    later = [ratio for n_updates, index, ratio in ratios if n_updates % 2 == 1]
    assert len(first) == n_iterations and max(first) < 1e-5
    assert min(later) > 1e-4  # the policy does move, so the zeros above say something
    if model.policy.has_belief:
        assert model.logger.name_to_value["belief/first_log_ratio"] < 1e-5


@pytest.mark.parametrize("inactive", [0, 3])
def test_first_log_ratio_is_zero(inactive):
    check_log_ratios(make_model(env_kwargs=dict(inactive=inactive), learning_rate=1e-2), n_iterations=4)


SWITCHES: list[dict[str, Any]] = [
    *(dict(belief=belief) for belief in (*VARIANTS[1:], "none")),
    dict(policy_latent="mean"),
    dict(similarity="observation"),
    dict(detach_belief=True),
    dict(action_loss="cross_entropy"),
]


@pytest.mark.parametrize("switches", SWITCHES, ids=lambda switches: "-".join(map(str, switches.values())))
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_first_log_ratio_is_zero_whatever_the_belief(algorithm, switches):
    model = make_model(algorithm=algorithm, env_kwargs=dict(inactive=3), learning_rate=1e-2, **switches)
    check_log_ratios(model, n_iterations=2)


@pytest.mark.parametrize("sde", [dict(use_sde=False), dict(use_sde=True), dict(use_sde=True, sde_sample_freq=3)])
@pytest.mark.parametrize("belief", ["dynamic", "static"])
def test_first_log_ratio_is_zero_for_continuous_actions(belief, sde):
    model = make_model(env_kwargs=dict(action_space=BOX), belief=belief, learning_rate=1e-2, **sde)
    check_log_ratios(model, n_iterations=2)


def test_another_noise_than_the_one_acted_with_is_noticed():
    # What the stored noise is for: drawn anew, the ratio would differ from 1 before any gradient step
    model = make_model(learning_rate=1e-2)
    add = model.rollout_buffer.add

    def add_other_noise(obs, action, reward, episode_start, values, log_prob):
        sampled = attached(values)
        add(obs, action, reward, episode_start, attach(values, sampled._replace(noise=-sampled.noise)), log_prob)

    model.rollout_buffer.add = add_other_noise
    model.learn(2 * ROLLOUT)
    assert model.logger.name_to_value["belief/first_log_ratio"] > 1e-3


def test_detached_belief_is_trained_by_its_own_loss_alone():
    detached = make_model(detach_belief=True, action_coef=0.0, kl_coef=0.0)
    not_detached = make_model(action_coef=0.0, kl_coef=0.0)
    for model, moves in ((detached, False), (not_detached, True)):
        before = model.policy.belief.encoder.weight.clone()
        model.learn(3 * ROLLOUT)
        assert th.equal(before, model.policy.belief.encoder.weight) != moves


def test_early_stopping_and_clipped_values_are_sb3s():
    model = make_model(target_kl=1e-9, clip_range_vf=0.1, learning_rate=1e-2, n_epochs=20).learn(3 * ROLLOUT)
    assert 3 <= model._n_updates < 10
    assert model.logger.name_to_value["belief/first_log_ratio"] < 1e-5


def test_a_callback_that_asks_the_policy_does_not_change_what_is_stored():
    class Asks(BaseCallback):
        def _on_step(self):
            obs: Any = obs_as_tensor(self.locals["new_obs"], self.model.device)
            with th.no_grad():
                # All copies, then greedily, then the first copy alone
                self.model.policy(obs)
                self.model.policy(obs, deterministic=True)
                self.model.policy(obs[:1])
            return True

    model = make_model(learning_rate=1e-2).learn(3 * ROLLOUT, callback=Asks())
    assert model.logger.name_to_value["belief/first_log_ratio"] < 1e-5


def test_minibatches_serve_the_policy_as_any_observations():
    model = make_model().learn(2 * ROLLOUT)
    samples = next(iter(model.rollout_buffer.get(None)))
    plain = th.as_tensor(samples.observations.numpy().copy())
    assert attached(samples.observations) is not None and attached(plain) is None
    assert th.equal(model.policy.predict_values(samples.observations), model.policy.predict_values(plain))


def test_an_update_attends_to_the_rows_that_acting_attended_to():
    # A large step, so that the most similar rows are others at the end of the update than in the rollout
    model = make_model(learning_rate=1e-1, n_epochs=4).learn(2 * ROLLOUT)
    beliefs, minibatches = record_beliefs(model.policy), []
    get = model.rollout_buffer.get

    def watched(batch_size):
        for samples in get(batch_size):
            minibatches.append(attached(samples.observations))
            yield samples

    model.rollout_buffer.get = watched
    model.learn(ROLLOUT)
    trained = [belief for belief in beliefs if belief.latent.requires_grad]
    assert len(trained) == len(minibatches) == 12
    for belief, minibatch in zip(trained, minibatches, strict=True):
        assert th.equal(belief.selected, minibatch.selected)
