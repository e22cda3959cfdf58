"""Policy names, what they stand for, and how a policy is made again."""

import inspect
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor, NatureCNN
from torch import nn

from sb3_belief.belief_ppo import (
    BeliefActorCriticPolicy,
    BeliefPPO,
    MaskableBeliefActorCriticPolicy,
    MaskableBeliefPPO,
)
from sb3_belief.belief_ppo.on_policy_details import ACTION_GAIN, DetailsPolicyMixin
from sb3_belief.belief_ppo.policies import BeliefPolicyMixin
from tests.belief_ppo.helpers import ALGORITHMS, SMALL, observations_of
from tests.belief_ppo.toy_envs import AmongOthers

VECTOR = spaces.Box(-1, 1, (5,), np.float32)
IMAGE = spaces.Box(0, 255, (3, 36, 40), np.uint8)
LAST = spaces.Box(0, 255, (40, 36, 3), np.uint8)
TINY = spaces.Box(0, 255, (3, 35, 60), np.uint8)
DICT = spaces.Dict(image=IMAGE, vector=VECTOR)


def made(algorithm, policy, observation_space, **kwargs):
    env = make_vec_env(AmongOthers, n_envs=2, env_kwargs=dict(observation_space=observation_space))
    return algorithm(policy, env, **{**SMALL, **kwargs})


@pytest.mark.parametrize("belief", ["static", "none"])
@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize(
    "name, observation_space, extractor",
    [
        ("BeliefPolicy", VECTOR, FlattenExtractor),
        ("BeliefPolicy", spaces.Discrete(4), FlattenExtractor),
        ("BeliefPolicy", spaces.MultiDiscrete([3, 2]), FlattenExtractor),
        ("BeliefPolicy", spaces.MultiBinary(4), FlattenExtractor),
        ("BeliefPolicy", IMAGE, NatureCNN),
        ("BeliefPolicy", LAST, NatureCNN),
        ("BeliefPolicy", TINY, FlattenExtractor),
        ("BeliefPolicy", DICT, CombinedExtractor),
        ("MlpPolicy", VECTOR, FlattenExtractor),
        ("MlpPolicy", IMAGE, FlattenExtractor),
        ("CnnPolicy", IMAGE, NatureCNN),
        ("MultiInputPolicy", DICT, CombinedExtractor),
    ],
)
def test_each_name_stands_for_the_extractor_that_sb3_has_for_it(algorithm, name, observation_space, extractor, belief):
    model = made(algorithm, name, observation_space, belief=belief)
    features = model.policy.features_extractor
    assert type(features.features if model.policy.has_belief else features) is extractor
    obs = observations_of(model, 4)
    assert model.predict(obs)[0].shape == (4,)


def stock_of(algorithm: Any) -> Any:
    """The algorithm of SB3 or sb3-contrib that one of ours is made from."""
    return next(kind for kind in algorithm.__mro__ if kind.__module__.startswith(("stable_baselines3.", "sb3_contrib.")))


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_names_are_sb3s_and_one_more(algorithm):
    stock = stock_of(algorithm)
    assert stock.__name__ == algorithm.stock
    assert set(algorithm.policy_aliases) == set(stock.policy_aliases) | {"BeliefPolicy"}
    for name, policy in stock.policy_aliases.items():
        ours = algorithm.policy_aliases[name]
        assert issubclass(ours, BeliefPolicyMixin) and not issubclass(policy, BeliefPolicyMixin)
        assert issubclass(ours, algorithm.policy_base)
    assert algorithm.policy_aliases["BeliefPolicy"] is algorithm.policy_base
    with pytest.raises(ValueError, match="unknown"):
        made(algorithm, "TransformerPolicy", VECTOR)


def test_an_extractor_of_the_users_own_is_kept():
    class Own(FlattenExtractor):
        pass

    for name in ("BeliefPolicy", "MlpPolicy"):
        model: Any = made(BeliefPPO, name, VECTOR, policy_kwargs=dict(features_extractor_class=Own))
        assert type(model.policy.features_extractor.features) is Own


# -- what a policy is made again from ----------------------------------------------------------------------------------

BOX = spaces.Box(-1, 1, (2,), np.float32)
OTHERS = {"b": spaces.Discrete(3), "c": spaces.MultiBinary(2)}
GIVEN: dict[str, Any] = dict(
    others_action_spaces=OTHERS,
    belief="context",
    history_length=17,
    keep_ratio=0.25,
    action_loss="cross_entropy",
    policy_latent="mean",
    similarity="observation",
    detach_belief=True,
    n_own=5,
    n_pool=7,
    row_features=("reward", "age"),
    history_dropout=0.25,
    prediction_steps=2,
    critic_sees_others=False,
    value_norm=True,
    obs_layer_norm=True,
    action_gain=ACTION_GAIN,
    belief_replay=3,
    embedding_dim=12,
    latent_dim=6,
    fusion_activation_fn=nn.Tanh,
    belief_from_features=True,
    net_arch=dict(pi=[9], vf=[8]),
    activation_fn=nn.ELU,
    ortho_init=False,
    share_features_extractor=True,
    normalize_images=False,
    optimizer_class=th.optim.SGD,
    optimizer_kwargs=dict(momentum=0.5),
)
SDE: dict[str, Any] = dict(use_sde=True, log_std_init=-1.0, full_std=False, use_expln=True, squash_output=True)


def accepted(policy_class: type) -> set[str]:
    """The names of all arguments that the constructors of a class take, those of its bases that it hands on included."""
    names: set[str] = set()
    for base in policy_class.__mro__:
        if "__init__" not in vars(base):
            continue
        parameters = inspect.signature(base.__init__).parameters.values()  # type: ignore[misc]
        names |= {p.name for p in parameters if p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)}
        if not any(p.kind == p.VAR_KEYWORD for p in parameters):
            return names - {"self"}
    raise AssertionError("no constructor without further arguments")


def policy_classes() -> list[Any]:
    aliases = (BeliefPPO.policy_aliases, MaskableBeliefPPO.policy_aliases)
    return sorted({policy for names in aliases for policy in names.values()}, key=lambda policy: policy.__name__)


@pytest.mark.parametrize("policy_class", policy_classes())
@pytest.mark.parametrize("sde", [False, True])
def test_a_policy_can_be_made_again_from_what_it_saves(policy_class, sde):
    if issubclass(policy_class, MaskableBeliefActorCriticPolicy) and sde:
        assert not accepted(policy_class) & set(SDE)
        return
    observation_space: spaces.Space = VECTOR
    if "Cnn" in policy_class.__name__:
        observation_space = spaces.Box(0, 1, (1, 36, 36), np.float32)
    elif "Multi" in policy_class.__name__:
        observation_space = spaces.Dict(vector=VECTOR)
    given: dict[str, Any] = {**GIVEN, **(SDE if sde else {}), "features_extractor_class": FlattenExtractor}
    given["features_extractor_kwargs"] = {}
    given.update(observation_space=observation_space, action_space=BOX if sde else spaces.Discrete(3))
    if "Cnn" in policy_class.__name__:
        given.update(features_extractor_class=NatureCNN, features_extractor_kwargs=dict(normalized_image=True))
    if "Multi" in policy_class.__name__:
        given.update(features_extractor_class=CombinedExtractor)
    names = accepted(policy_class)
    missing = names - set(given) - {"lr_schedule"}
    assert missing == (set() if sde or issubclass(policy_class, MaskableBeliefActorCriticPolicy) else set(SDE))

    policy = policy_class(lr_schedule=lambda _: 1e-3, **given)
    data = policy._get_constructor_parameters()
    assert names == set(data)
    for name, value in given.items():
        assert data[name] == value, name
    again = policy_class(**data)
    assert {k: v.shape for k, v in again.state_dict().items()} == {k: v.shape for k, v in policy.state_dict().items()}
    assert {**again._get_constructor_parameters(), "lr_schedule": None} == {**data, "lr_schedule": None}


@pytest.mark.parametrize(
    "algorithm, base", [(BeliefPPO, BeliefActorCriticPolicy), (MaskableBeliefPPO, MaskableBeliefActorCriticPolicy)]
)
def test_an_algorithm_takes_all_arguments_of_the_one_it_is_made_from(algorithm, base):
    def arguments(cls):
        return {name: p.default for name, p in inspect.signature(cls.__init__).parameters.items() if name != "policy"}

    ours, stock = arguments(algorithm), arguments(stock_of(algorithm))
    assert list(ours)[: len(stock)] == list(stock) and {name: ours[name] for name in stock} == stock
    added = set(ours) - set(stock)
    # What a user says about the belief has the same default wherever it can be said
    policy = {name: p.default for name, p in inspect.signature(BeliefPolicyMixin.__init__).parameters.items()}
    policy |= {name: p.default for name, p in inspect.signature(DetailsPolicyMixin.__init__).parameters.items()}
    of_training = {"action_coef", "kl_coef", "huber_delta", "value_clip", "active_masks"}
    assert added - of_training <= set(policy)
    assert all(ours[name] == policy[name] for name in added - of_training)
    for name in added:
        assert f":param {name}:" in algorithm.__doc__
    of_learn = inspect.signature(algorithm.learn).parameters
    for name, p in inspect.signature(stock_of(algorithm).learn).parameters.items():
        assert name in of_learn and (name == "tb_log_name" or of_learn[name].default == p.default)
    assert of_learn["tb_log_name"].default == algorithm.__name__
    assert algorithm.policy_base is base
