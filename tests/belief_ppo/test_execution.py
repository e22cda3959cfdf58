"""Acting with a trained belief."""

import numpy as np
import pytest
import torch as th

from tests.belief_ppo.helpers import EVERY, ROLLOUT, VARIANTS, make_model, observations_of, record_beliefs


def test_deterministic_uses_the_mean_and_sampling_draws():
    model = make_model().learn(ROLLOUT)
    obs = np.repeat(model.observation_space.sample()[None], 64, axis=0)
    tensor, outputs = th.as_tensor(obs), record_beliefs(model.policy)
    model.predict(obs, deterministic=True)
    output = outputs[-1]
    assert th.equal(output.latent, output.mean)
    model.predict(obs, deterministic=False)
    output = outputs[-1]
    assert (output.latent - output.mean).std(dim=0).min() > 0
    values = [model.policy.predict_values(tensor) for _ in range(2)]
    assert th.equal(*values) and th.equal(outputs[-1].latent, output.mean)
    # The cached history is the same as the one encoded afresh
    assert th.allclose(values[0], model.policy.predict_values(tensor.clone().requires_grad_()), atol=1e-6)


def test_cached_history_follows_weights_and_history():
    model = make_model().learn(ROLLOUT)
    tensor = th.as_tensor(model.observation_space.sample()[None])

    def value():
        with th.no_grad():
            return model.policy.predict_values(tensor).item()

    seen = [value()]
    with th.no_grad():
        model.policy.belief.value.weight.mul_(2)
    seen.append(value())
    model.policy.remember(np.random.default_rng(0).normal(size=(5, 5)).astype(np.float32), np.zeros((5, 7), np.float32))
    seen.append(value())
    state = {name: tensor + 0.1 if "key" in name else tensor for name, tensor in model.policy.state_dict().items()}
    model.policy.load_state_dict(state)
    seen.append(value())
    assert len(set(seen)) == 4
    model.policy.belief.train()
    assert value() == pytest.approx(model.policy.predict_values(tensor).item(), abs=1e-6)  # encoded afresh under autograd


@pytest.mark.parametrize("belief", VARIANTS)
@pytest.mark.parametrize("policy_latent", ["sample", "mean"])
def test_what_policy_and_value_are_given(belief, policy_latent):
    model = make_model(belief=belief, policy_latent=policy_latent).learn(2 * ROLLOUT)
    tensor, policy = th.as_tensor(observations_of(model, 9)), model.policy
    samples = belief in ("dynamic", "variational")
    values, outputs = [], record_beliefs(policy)
    for _ in range(2):
        values.append(policy(tensor)[1])
        output = outputs[-1]
        assert th.equal(output.latent, output.mean) != samples  # the decoder's, whatever the policy is given
        if output.prediction is not None:
            th.testing.assert_close(output.prediction, policy.belief.decoder(output.latent))
    assert th.equal(*values) != (samples and policy_latent == "sample")
    assert th.equal(policy(tensor, deterministic=True)[1], policy.predict_values(tensor))


@pytest.mark.parametrize("algorithm, belief", EVERY)
def test_deterministic_predictions_do_not_depend_on_company_or_chance(belief, algorithm):
    model = make_model(belief=belief, algorithm=algorithm).learn(2 * ROLLOUT)
    obs = observations_of(model, 30)
    together = model.predict(obs, deterministic=True)[0]
    alone = [model.predict(row, deterministic=True)[0] for row in obs]
    np.testing.assert_array_equal(together, np.stack(alone))
    assert alone[0].shape == ()
