"""What an exported agent computes is what its policy computes, without this package and for any number of observations."""

import subprocess
import sys
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import A2C, DQN
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import VecNormalize

from sb3_belief import Team, make_team_env
from sb3_belief.baselines import AMFPPO, IAC
from sb3_belief.belief_ppo import BeliefActorCriticPolicy, BeliefPPO, MaskableBeliefPPO
from sb3_belief.common.action_masks import mask_parts
from sb3_belief.export import export_model
from sb3_belief.export.graph import PolicyGraph
from sb3_belief.references import MAPPO, WithState
from tests.baselines.test_iac import Unmasked
from tests.belief_ppo.helpers import SMALL, make_model, observations_of
from tests.belief_ppo.toy_envs import AmongOthers
from tests.references.test_mappo import Stateful

N = 1000
IMAGE = spaces.Box(0, 255, (36, 40, 3), np.uint8)
MIXED = spaces.Dict(image=IMAGE, kind=spaces.Discrete(4), place=spaces.Box(-1, 1, (3,), np.float32))
ANY_OTHERS = {"b": spaces.MultiDiscrete([2, 3]), "c d": spaces.MultiBinary(2), "e": spaces.Box(-1, 1, (2,), np.float32)}
# Where observations are much alike, rounding may decide which rows are selected; hence all of them there
ALL_ROWS = dict(keep_ratio=1.0)
CASES = {
    "dynamic": (BeliefPPO, {}, {}),
    "Dict, Box": (
        BeliefPPO,
        dict(similarity="observation", policy_latent="mean", **ALL_ROWS),
        dict(observation_space=MIXED, action_space=spaces.Box(-1, 1, (2, 2), np.float32)),
    ),
    "context, cross-entropy, image, MultiDiscrete": (
        BeliefPPO,
        dict(belief="context", action_loss="cross_entropy", **ALL_ROWS),
        dict(observation_space=IMAGE, action_space=spaces.MultiDiscrete([2, 3])),
    ),
    "static, others of all kinds, gSDE": (
        BeliefPPO,
        dict(belief="static", use_sde=True),
        dict(others=ANY_OTHERS, action_space=spaces.Box(-1, 1, (2,), np.float32)),
    ),
    "adaptive": (BeliefPPO, dict(belief="adaptive", action_loss="cross_entropy"), {}),
    "wide, MultiBinary": (
        BeliefPPO,
        dict(belief="wide"),
        dict(observation_space=spaces.MultiBinary(30), action_space=spaces.MultiBinary(3)),
    ),
    "no belief, masked": (MaskableBeliefPPO, dict(belief="none"), dict(observation_space=spaces.Discrete(5))),
    "masked MultiDiscrete": (MaskableBeliefPPO, {}, dict(action_space=spaces.MultiDiscrete([2, 4]))),
    "masked MultiBinary": (MaskableBeliefPPO, {}, dict(action_space=spaces.MultiBinary(3))),
}


def trained(algorithm, kwargs, env_kwargs):
    return make_model(algorithm=algorithm, env_kwargs=env_kwargs, **kwargs).learn(84)


def inputs_of(model, n=N):
    """Observations as the policy's space has them, by input name; and random masks that leave each choice an option."""
    observations = observations_of(model, n)
    inputs = {"observation": observations}
    if isinstance(observations, dict):
        inputs = {f"observation.{key}": rows for key, rows in observations.items()}
    if isinstance(model, MaskableBeliefPPO):
        space = model.action_space
        widths = [space.n] if isinstance(space, spaces.Discrete) else getattr(space, "nvec", [2] * spaces.flatdim(space))
        masks = [np.random.default_rng(0).random((n, width)) < 0.6 for width in widths]
        for mask in masks:
            mask[:, 0] |= ~mask.any(axis=1)
        inputs["action_mask"] = np.concatenate(masks, axis=1)
    return observations, inputs


def expected_outputs(model, observations, masks=None):
    """What SB3 and ``predict_others`` say."""
    policy = model.policy
    policy.set_training_mode(False)
    with th.no_grad():
        tensors = policy.obs_to_tensor(observations)[0]
        made = policy.get_distribution(tensors) if masks is None else policy.get_distribution(tensors, masks)
    found = getattr(made, "distributions", None) or made.distribution
    if isinstance(model.action_space, spaces.Box):
        shape = (len(found.mean), *model.action_space.shape)
        outputs = {"action_mean": found.mean.view(shape).numpy(), "action_std": found.stddev.view(shape).numpy()}
    elif isinstance(found, list):
        probabilities = th.cat([part.probs for part in found], dim=1)
        if isinstance(model.action_space, spaces.MultiBinary):
            probabilities = probabilities[:, 1::2]
        outputs = {"action_probabilities": probabilities.numpy()}
    else:
        outputs = {"action_probabilities": found.probs.numpy()}
    if getattr(policy, "has_belief", False) and policy.options.belief != "wide":
        believed = policy.predict_others(observations)
        outputs |= {f"others.{name}": rows for name, rows in believed.actions.items()} | {"belief_mean": believed.mean}
        if policy.options.variant.samples:
            outputs["belief_std"] = believed.std
    return outputs


def test_a_policy_that_remembers_several_copies_is_exported_as_one_of_them():
    model = trained(BeliefPPO, dict(belief="adaptive"), {})
    with th.no_grad():
        # As sharp as after a longer training
        model.policy.action_net.weight.mul_(100)
    model.policy.remember(observations_of(model, 2), {"b": np.array([0, 1])}, copies=np.array([0, 1]))
    assert model.policy.features_extractor.n_copies == 2
    observations, inputs = inputs_of(model)
    with th.no_grad():
        found = PolicyGraph(model)(*map(th.as_tensor, inputs.values()))["action_probabilities"]
    for i in range(N):
        expected = expected_outputs(model, observations[i : i + 1])["action_probabilities"]
        np.testing.assert_allclose(found[i : i + 1].numpy(), expected, atol=2e-6, rtol=2e-5)


def run_onnx(path, inputs):
    session = onnxruntime.InferenceSession(path)
    assert {each.name for each in session.get_inputs()} == inputs.keys()
    names = [each.name for each in session.get_outputs()]
    return dict(zip(names, session.run(None, inputs), strict=True))


def assert_equal_outputs(found, expected):
    assert {*expected} <= {*found} <= {*expected, "belief_mean"}
    for name, rows in expected.items():
        assert found[name].shape == rows.shape and found[name].dtype == np.float32
        np.testing.assert_allclose(found[name], rows, atol=2e-6, rtol=2e-5, err_msg=name)


@pytest.mark.parametrize("case", CASES)
def test_onnxruntime_computes_what_the_policy_computes(case, tmp_path):
    model = trained(*CASES[case])
    observations, inputs = inputs_of(model)
    export_model(model, tmp_path / "a.onnx", "onnx")
    assert [path.name for path in tmp_path.iterdir()] == ["a.onnx"]
    expected = expected_outputs(model, observations, inputs.get("action_mask"))
    assert_equal_outputs(run_onnx(tmp_path / "a.onnx", inputs), expected)
    # One at a time, too
    one = {name: rows[:1] for name, rows in inputs.items()}
    assert_equal_outputs(run_onnx(tmp_path / "a.onnx", one), {name: rows[:1] for name, rows in expected.items()})


RUN_PROGRAM = """
import sys
import numpy as np
import torch

inputs = np.load("inputs.npz")
outputs = torch.export.load("a.pt2").module()(*(torch.as_tensor(inputs[name]) for name in inputs))
np.savez("outputs.npz", **{name: rows.detach().numpy() for name, rows in outputs.items()})
assert not {"sb3_belief", "stable_baselines3"} & set(sys.modules)
"""


@pytest.mark.parametrize("case", ["dynamic", "masked MultiBinary"])
def test_pytorch_alone_computes_what_the_policy_computes(case, tmp_path):
    model = trained(*CASES[case])
    observations, inputs = inputs_of(model)
    export_model(model, tmp_path / "a.pt2", "torch")
    np.savez(tmp_path / "inputs.npz", **inputs)
    result = subprocess.run([sys.executable, "-c", RUN_PROGRAM], cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert_equal_outputs(np.load(tmp_path / "outputs.npz"), expected_outputs(model, observations, inputs.get("action_mask")))


def test_an_agent_without_a_past_is_exported_too(tmp_path):
    model = make_model()
    export_model(model, tmp_path / "a.onnx", "onnx")
    observations, inputs = inputs_of(model, 10)
    assert_equal_outputs(run_onnx(tmp_path / "a.onnx", inputs), expected_outputs(model, observations))


def test_the_history_is_that_of_the_export(tmp_path):
    model = trained(BeliefPPO, {}, {})
    observations, inputs = inputs_of(model, 50)
    before = expected_outputs(model, observations)
    export_model(model, tmp_path / "a.onnx", "onnx")
    model.policy.remember(observations, {"b": np.zeros(50, dtype=int)})
    assert_equal_outputs(run_onnx(tmp_path / "a.onnx", inputs), before)
    export_model(model, tmp_path / "a.onnx", "onnx")
    after = expected_outputs(model, observations)
    assert abs(after["belief_mean"] - before["belief_mean"]).max() > 1e-3
    assert_equal_outputs(run_onnx(tmp_path / "a.onnx", inputs), after)


def test_where_all_predictions_are_negative_the_expected_action_is_uniform(tmp_path):
    model = make_model()
    with th.no_grad():
        model.policy.belief.decoder.bias.fill_(-100)
    export_model(model, tmp_path / "a.onnx", "onnx")
    _, inputs = inputs_of(model, 5)
    assert np.allclose(run_onnx(tmp_path / "a.onnx", inputs)["others.c"], 0.25)


@pytest.mark.parametrize("dict_keys", [None, ["place"]])
def test_normalisation_is_part_of_the_file(dict_keys, tmp_path):
    space = MIXED if dict_keys else spaces.Box(-1, 1, (5,), np.float32)
    env = make_vec_env(AmongOthers, n_envs=3, seed=0, env_kwargs=dict(observation_space=space))
    env = VecNormalize(env, clip_obs=0.7, norm_obs_keys=dict_keys)
    model = BeliefPPO("BeliefPolicy", env, **{**SMALL, **ALL_ROWS}).learn(84)
    observations, inputs = inputs_of(model)
    export_model(model, tmp_path / "a.onnx", "onnx", env)
    assert_equal_outputs(run_onnx(tmp_path / "a.onnx", inputs), expected_outputs(model, env.normalize_obs(observations)))


def test_policies_of_sb3_are_exported_or_refused(tmp_path):
    a2c = A2C("MlpPolicy", "CartPole-v1", device="cpu")
    export_model(a2c, tmp_path / "a.onnx", "onnx")
    observations = np.random.default_rng(0).normal(size=(N, 4)).astype(np.float32)
    found = run_onnx(tmp_path / "a.onnx", {"observation": observations})
    assert_equal_outputs(found, expected_outputs(a2c, observations))

    with pytest.raises(ValueError, match=r"DQN cannot be exported: its DQNPolicy is not an actor-critic policy.* A2C"):
        export_model(DQN("MlpPolicy", "CartPole-v1", buffer_size=10), tmp_path / "b.onnx", "onnx")
    from sb3_contrib import RecurrentPPO

    with pytest.raises(ValueError, match=r"RecurrentPPO cannot be exported: .* has a recurrent state"):
        export_model(RecurrentPPO("MlpLstmPolicy", "CartPole-v1", n_steps=8), tmp_path / "b.onnx", "onnx")
    squashed = A2C("MlpPolicy", "Pendulum-v1", use_sde=True, policy_kwargs=dict(squash_output=True))
    with pytest.raises(ValueError, match="squashes its actions"):
        export_model(squashed, tmp_path / "b.onnx", "onnx")
    with pytest.raises(ValueError, match="the format is 'tf'; it must be one of 'onnx', 'torch'"):
        export_model(a2c, tmp_path / "b.tf", "tf")
    with pytest.raises(ValueError, match=r"in the format 'torch'; end it in .pt2"):
        export_model(a2c, tmp_path / "b.onnx", "torch")
    assert [path.name for path in tmp_path.iterdir()] == ["a.onnx"]


def one_of_a_team(algorithm, policy, env):
    team = Team(algorithm, policy, env, seed=0, n_steps=8, batch_size=16, n_epochs=1, device="cpu").learn(16)
    return team.agents["agent_1"]


def test_of_mappo_the_agents_own_observation_is_enough(tmp_path):
    model: Any = one_of_a_team(MAPPO, "MultiInputPolicy", WithState(make_team_env(Stateful, n_envs=2, seed=0)))
    export_model(model, tmp_path / "a.onnx", "onnx")
    own = np.stack([model.observation_space["obs"].sample() for _ in range(N)])
    assert_equal_outputs(run_onnx(tmp_path / "a.onnx", {"observation": own}), expected_outputs(model, own))


def test_policy_features_are_exported_in_both_formats(tmp_path):
    model: Any = one_of_a_team(AMFPPO, "MlpPolicy", make_team_env(Stateful, n_envs=2, seed=0))
    observations, inputs = inputs_of(model)
    expected = expected_outputs(model, observations)
    export_model(model, tmp_path / "a.onnx", "onnx")
    assert_equal_outputs(run_onnx(tmp_path / "a.onnx", inputs), expected)
    export_model(model, tmp_path / "a.pt2", "torch")
    program = th.export.load(tmp_path / "a.pt2").module()
    found = {name: rows.detach().numpy() for name, rows in program(th.as_tensor(observations)).items()}
    assert_equal_outputs(found, expected)


class Sharper(BeliefActorCriticPolicy):
    """Acts on other probabilities than its networks give."""

    def get_distribution(self, obs):
        made = super().get_distribution(obs)
        return made.proba_distribution(2 * made.distribution.logits)  # type: ignore[union-attr]


class Extractor(FlattenExtractor):
    """Features of the user's own."""

    def forward(self, observations):
        return super().forward(observations).tanh()


def test_networks_of_ones_own_are_exported_and_passes_of_ones_own_are_refused(tmp_path):
    model = make_model(policy_kwargs=dict(features_extractor_class=Extractor)).learn(84)
    observations, inputs = inputs_of(model)
    export_model(model, tmp_path / "a.onnx", "onnx")
    assert_equal_outputs(run_onnx(tmp_path / "a.onnx", inputs), expected_outputs(model, observations))

    own = BeliefPPO(Sharper, make_vec_env(AmongOthers), **SMALL)
    with pytest.raises(ValueError, match=r"the get_distribution\(\) of its Sharper does something else"):
        export_model(own, tmp_path / "b.onnx", "onnx")


def test_without_onnx_there_is_a_line_that_installs_it(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "onnxscript", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'sb3-belief\[export\]'"):
        export_model(make_model(), tmp_path / "a.onnx", "onnx")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("action_space", [spaces.Discrete(4), spaces.MultiDiscrete([2, 4])], ids=str)
def test_masks_of_iac_are_an_input_where_it_has_learned_with_them(tmp_path, action_space):
    for env_class, masked in ((AmongOthers, True), (Unmasked, False)):
        env = make_vec_env(env_class, n_envs=2, seed=0, env_kwargs=dict(action_space=action_space))
        model: Any = IAC("MlpPolicy", env, n_steps=8, seed=0, device="cpu").learn(32)
        export_model(model, tmp_path / "iac.onnx", "onnx")
        observations = observations_of(model, 6)
        inputs = {"observation": observations}
        masks = np.ones((6, sum(mask_parts(action_space))), dtype=bool)
        masks[::2, 1] = False
        if masked:
            inputs["action_mask"] = masks
        with th.no_grad(), model.policy.masked(masks if masked else None):
            made = model.policy.get_distribution(th.as_tensor(observations))
        parts = made.distribution if isinstance(made.distribution, list) else [made.distribution]
        expected = th.cat([part.probs for part in parts], dim=1).numpy()
        (found,) = run_onnx(tmp_path / "iac.onnx", inputs).values()
        np.testing.assert_allclose(found, expected, atol=2e-6, rtol=2e-5)
        assert (found[::2, 1] == 0).all() == masked
