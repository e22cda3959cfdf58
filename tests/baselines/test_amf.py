"""AMF: policy features that predict the others are multiplied with the agent's own, and everything trains everything."""

import io
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from torch.nn import functional as F

from sb3_belief.baselines.amf import AMFPPO, AMFPolicy, MaskableAMFPPO
from sb3_belief.belief_ppo.buffers import attached
from sb3_belief.cli.main import main
from tests.belief_ppo.helpers import ROLLOUT, same_parameters
from tests.belief_ppo.toy_envs import AmongOthers, MaskedAmongOthers
from tests.team.exact.test_exact import SaveOnce
from tests.team.helpers import Team, make_team_env, parameters
from tests.team.toy_envs import ToyEnv

SMALL: dict[str, Any] = dict(
    n_steps=14, batch_size=14, n_epochs=2, seed=0, device="cpu", policy_kwargs=dict(hidden_dim=16, action_gain=1.0)
)
ALGORITHMS = [AMFPPO, MaskableAMFPPO]


def make_model(algorithm: Any = AMFPPO, env_kwargs: Any = None, **kwargs: Any) -> Any:
    env_class = MaskedAmongOthers if algorithm is MaskableAMFPPO else AmongOthers
    return algorithm("MlpPolicy", make_vec_env(env_class, n_envs=3, seed=0, env_kwargs=env_kwargs), **{**SMALL, **kwargs})


def layers(model):
    """W_0, W_x, W_p, W_j of a model, each with its bias."""
    policy = model.policy
    extractor = policy.features_extractor
    return extractor.features.layer[0], policy.mlp_extractor.own[0], extractor.belief.encoder[0], extractor.belief.decoder


def minibatch_of(model):
    samples = next(model.rollout_buffer.get(14))
    return samples, attached(samples.observations)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_networks_are_the_equations(algorithm):
    model = make_model(algorithm)
    first, own, encoder, decoder = layers(model)
    obs = th.rand(6, 5)
    e = th.relu(first(obs))
    x, p = th.relu(own(e)), th.relu(encoder(e))
    z = x * p
    th.testing.assert_close(model.policy.get_distribution(obs).distribution.logits, _normed(model.policy.action_net(z)))
    th.testing.assert_close(model.policy.predict_values(obs), model.policy.value_net(z))
    believed = model.policy.predict_others(obs.numpy())
    expected = [F.softmax(part, dim=1).detach().numpy() for part in decoder(p).split([3, 4], dim=1)]
    for found, wanted in zip(believed.actions.values(), expected, strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-6)
    assert {layer.out_features for layer in (first, own, encoder)} == {16}


def _normed(logits):
    return logits - logits.logsumexp(dim=-1, keepdim=True)


def test_the_task_is_the_cross_entropy_averaged_over_the_visible():
    model = make_model()
    model.learn(ROLLOUT)
    samples, minibatch = minibatch_of(model)
    output = model.policy.features_extractor.infer(model.policy.flat_observations(samples.observations))
    visible, actions = minibatch.others_visible, minibatch.others_actions
    total, n = th.zeros(()), 0
    for row in range(len(visible)):
        for j, columns in enumerate((slice(0, 3), slice(3, 7))):
            if visible[row, j]:
                target = actions[row, columns].argmax()
                total, n = total + F.cross_entropy(output.prediction[row, columns], target), n + 1
    assert 0 < n < visible.numel()
    th.testing.assert_close(model.policy.action_error(output.prediction, minibatch), total / n)
    hidden = minibatch._replace(others_visible=th.zeros_like(visible))
    assert model.policy.action_error(output.prediction, hidden).item() == 0.0


def test_nothing_is_stopped():
    model = make_model()
    model.learn(ROLLOUT)
    samples, minibatch = minibatch_of(model)
    weights = [layer.weight for layer in layers(model)]
    obs = samples.observations.clone()
    values, log_prob, _ = model.policy.evaluate_actions(obs, samples.actions.long().flatten())
    e = model.policy.features_extractor.features(obs)
    prediction = model.policy.action_error(model.policy.features_extractor.belief(e).prediction, minibatch)
    reached = {}
    for name, loss in (("policy", log_prob.sum()), ("value", values.sum()), ("prediction", prediction)):
        found = th.autograd.grad(loss, weights, retain_graph=True, allow_unused=True)
        reached[name] = [gradient is not None and bool(gradient.abs().max() > 0) for gradient in found]
    # W_0, W_x, W_p, W_j
    assert reached == {
        "policy": [True, True, True, False],
        "value": [True, True, True, False],
        "prediction": [True, False, True, True],
    }


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_update_is_the_sum_of_both_losses(algorithm):
    # One step of plain SGD: the difference between two weights of the task is the task's own gradient
    def step(coef):
        kwargs = dict(optimizer_class=th.optim.SGD, hidden_dim=16)
        more: dict[str, Any] = dict(n_epochs=1, batch_size=ROLLOUT, max_grad_norm=1e9, policy_kwargs=kwargs)
        model = make_model(algorithm, action_coef=coef, **more)
        before = {name: value.clone() for name, value in model.policy.named_parameters()}
        model.learn(ROLLOUT)
        return model, {name: (before[name] - value).detach() for name, value in model.policy.named_parameters()}

    model, without = step(0.0)
    _, once = step(1.0)
    _, twice = step(2.0)
    for name in without:
        th.testing.assert_close(twice[name] - once[name], once[name] - without[name], atol=2e-7, rtol=1e-3, msg=name)
    changed = {name for name in without if (once[name] - without[name]).abs().max() > 1e-7}
    decoder, shared = "features_extractor.belief.decoder.weight", "features_extractor.features.layer.0.weight"
    assert {decoder, shared, "features_extractor.belief.encoder.0.weight"} <= changed
    assert not any(name.startswith(("action_net", "value_net", "mlp_extractor")) for name in changed)
    assert without[decoder].abs().max() == 0
    assert model.action_coef(1.0) == 0.0


def test_the_control_does_not_depend_on_what_others_do():
    class Others(AmongOthers):
        """What others are seen to do depends on ``shift``, and nothing else does."""

        def __init__(self, shift=0):
            super().__init__()
            self.shift = shift

        def _info(self):
            info = super()._info()
            parts = np.split(info["others_actions"], [3])
            return {**info, "others_actions": np.concatenate([np.roll(part, self.shift) for part in parts])}

    def learned(coef, shift):
        env = make_vec_env(Others, n_envs=3, seed=0, env_kwargs=dict(shift=shift))
        return AMFPPO("MlpPolicy", env, action_coef=coef, **SMALL).learn(2 * ROLLOUT)

    assert same_parameters(learned(0.0, 0), learned(0.0, 1))
    assert not same_parameters(learned(0.5, 0), learned(0.5, 1))


def test_the_weight_may_be_a_schedule():
    model = make_model(action_coef=lambda left: 0.1 + left)
    model.learn(2 * ROLLOUT)
    # Of the last update, when nothing is left
    assert model.logger.name_to_value["train/action_coef"] == pytest.approx(0.1)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_saved_and_loaded_it_is_the_same(algorithm, tmp_path):
    model = make_model(algorithm, value_norm=True).learn(ROLLOUT)
    model.save(tmp_path / "model.zip")
    loaded = algorithm.load(tmp_path / "model.zip", env=model.get_env())
    assert same_parameters(model, loaded)
    assert type(loaded.policy) is type(model.policy)
    loaded.learn(ROLLOUT)


def test_it_learns_in_a_team_and_is_resumed_exactly():
    def make():
        return make_team_env(ToyEnv, n_envs=2, seed=0)

    kwargs = {**SMALL, "batch_size": 28}
    whole, callback = Team(AMFPPO, "MlpPolicy", make(), **kwargs), SaveOnce(at=28)
    whole.learn(84, callback=callback)
    resumed = Team.load(io.BytesIO(callback.saved), env=make(), exact=True)
    resumed.learn(84 - resumed.num_timesteps, callback=SaveOnce(), reset_num_timesteps=False)
    for agent, model in whole.agents.items():
        assert th.equal(parameters(model), parameters(resumed.agents[agent]))


def test_dict_observations_and_inactive_steps():
    space = spaces.Dict({"a": spaces.Box(-1, 1, (3,), np.float32), "b": spaces.Discrete(4)})
    env = make_vec_env(AmongOthers, n_envs=3, seed=0, env_kwargs=dict(observation_space=space, inactive=3))
    model: Any = AMFPPO("MultiInputPolicy", env, **SMALL)
    model.learn(ROLLOUT)
    assert 0 < model.rollout_buffer.active.sum() < ROLLOUT
    assert model.policy.features_extractor.features.layer[0].in_features == 7


@pytest.mark.parametrize("algo", ["amf_ppo", "maskable_amf_ppo"])
def test_train_py_trains_it(tmp_path, algo):
    words = ["--algo", algo, "--env", "traffic-junction-easy", "-f", str(tmp_path), "-n", "80", "--eval-freq", "-1"]
    params = ["n_envs:2", "n_steps:20", "batch_size:40", "n_epochs:1", "policy_kwargs.hidden_dim:8", "action_coef:lin_0.5"]
    assert main(["train", *words, "--verbose", "0", "-params", *params]) == 0


@pytest.mark.parametrize(
    "kwargs, message",
    [
        (dict(belief="dynamic"), "belief is 'dynamic'; AMF is what it is with belief='static'"),
        (dict(action_loss="mse"), "action_loss is 'mse'; AMF is what it is with action_loss='cross_entropy'"),
        (dict(detach_belief=True), "detach_belief is True; AMF is what it is with detach_belief=False"),
        (dict(policy_kwargs=dict(net_arch=[8])), "net_arch is .*use hidden_dim instead"),
        (dict(policy_kwargs=dict(hidden_dim=0)), "hidden_dim=0 must be an integer >= 1"),
        (dict(env_kwargs=dict(others={"b": spaces.Box(-1, 1, (2,))})), "needs actions that are chosen from a finite set"),
    ],
)
def test_what_makes_no_sense_is_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_model(**kwargs)


def test_a_policy_without_these_networks_is_refused():
    with pytest.raises(ValueError, match="needs a policy with a belief"):
        AMFPPO(AMFPolicy.__base__.__mro__[1], make_vec_env(AmongOthers, 1))  # type: ignore[union-attr]
