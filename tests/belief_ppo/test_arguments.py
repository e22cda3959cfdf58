"""What a user can say: that it matters, and that nonsense is refused with a way out."""

from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import LinearSchedule
from torch import nn

from sb3_belief.belief_ppo import BeliefPPO, MaskableBeliefPPO
from tests.belief_ppo.helpers import ALGORITHMS, ROLLOUT, SMALL, make_model, same_parameters
from tests.belief_ppo.toy_envs import AmongOthers

# -- every argument matters --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "kwargs",
    [
        dict(history_length=20),
        dict(keep_ratio=0.5),
        dict(action_coef=0.0),
        dict(kl_coef=0.1),
        dict(action_loss="cross_entropy"),
        dict(policy_latent="mean"),
        dict(similarity="observation"),
        dict(detach_belief=True),
        *(dict(belief=belief) for belief in ("context", "variational", "static", "wide", "none")),
        dict(action_coef=LinearSchedule(0.5, 0.0, 1.0)),
        dict(kl_coef=LinearSchedule(0.005, 1.0, 1.0)),
        dict(policy_kwargs=dict(fusion_activation_fn=nn.Identity)),
        dict(policy_kwargs=dict(embedding_dim=16)),
        dict(policy_kwargs=dict(latent_dim=16)),
    ],
    ids=str,
)
def test_every_argument_matters(kwargs, plain):
    model = make_model(**kwargs).learn(2 * ROLLOUT)
    found, expected = dict(model.policy.named_parameters()), dict(plain.policy.named_parameters())
    differ = [name for name in found.keys() & expected.keys() if not same(found[name], expected[name])]
    assert "action_net.weight" in differ


@pytest.fixture(scope="module")
def plain():
    """The model without any further argument, trained; so the same arguments train it the same."""
    model = make_model().learn(2 * ROLLOUT)
    assert same_parameters(model, make_model().learn(2 * ROLLOUT))
    return model


def same(a: th.Tensor, b: th.Tensor) -> bool:
    return a.shape == b.shape and th.equal(a, b)


@pytest.mark.parametrize("belief", ["context", "static", "wide"])
@pytest.mark.parametrize("kwargs", [dict(policy_latent="mean"), dict(kl_coef=0.5)], ids=str)
def test_a_belief_that_is_a_single_point_has_no_use_for_what_shapes_a_distribution(belief, kwargs):
    switched = make_model(belief=belief, **kwargs).learn(2 * ROLLOUT)
    assert same_parameters(make_model(belief=belief).learn(2 * ROLLOUT), switched)


# -- schedules ---------------------------------------------------------------------------------------------------------


class SetByHand(BaseCallback):
    """Gives a coefficient a value of its own in each iteration."""

    def __init__(self, name: str, values: list[float]) -> None:
        super().__init__()
        self.name, self.values = name, values

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        value = self.values.pop(0)
        setattr(self.model, self.name, lambda progress_remaining: value)


class Logged(BaseCallback):
    """Keeps one value of the log, of each update but the last."""

    def __init__(self, name: str) -> None:
        super().__init__()
        self.name = name
        self.values: list[float] = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if self.name in self.logger.name_to_value:
            self.values.append(self.logger.name_to_value[self.name])


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("name", ["action_coef", "kl_coef"])
def test_a_schedule_equals_constants_set_by_hand(algorithm, name):
    def falling(progress_remaining: float) -> float:
        return 0.1 + 2 * progress_remaining**2

    constants = [0.1 + 2 * (1 - done / 3) ** 2 for done in (1, 2, 3)]
    log = Logged(f"train/{name}")
    scheduled = make_model(algorithm=algorithm, **{name: falling}).learn(3 * ROLLOUT, callback=log, log_interval=100)
    by_hand = make_model(algorithm=algorithm).learn(3 * ROLLOUT, callback=SetByHand(name, constants[:]))
    assert same_parameters(scheduled, by_hand)
    assert not same_parameters(scheduled, make_model(algorithm=algorithm, **{name: constants[0]}).learn(3 * ROLLOUT))
    last = scheduled.logger.name_to_value[f"train/{name}"]
    assert [*log.values, last] == pytest.approx(constants)


def test_a_constant_is_a_schedule_that_does_not_change():
    models = [make_model(action_coef=coef).learn(2 * ROLLOUT) for coef in (0.25, lambda progress_remaining: 0.25)]
    assert same_parameters(*models)


def test_numbers_may_be_numpys():
    kwargs: dict[str, Any] = dict(history_length=20, action_coef=0.25)
    plain = make_model(policy_kwargs=dict(latent_dim=8), **kwargs).learn(2 * ROLLOUT)
    kwargs = dict(history_length=np.int64(20), action_coef=np.float32(0.25))
    assert same_parameters(plain, make_model(policy_kwargs=dict(latent_dim=np.int32(8)), **kwargs).learn(2 * ROLLOUT))


@pytest.mark.parametrize("name", ["action_coef", "kl_coef"])
def test_a_schedule_that_falls_below_zero_is_refused(name):
    model = make_model(**{name: lambda progress_remaining: progress_remaining - 0.75})
    with pytest.raises(ValueError, match=rf"the schedule {name} gives -0.25 with 0.500 of the training left.*at least 0"):
        model.learn(2 * ROLLOUT)


# -- what is refused ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "kwargs, message",
    [
        (dict(belief="psychic"), "'dynamic', 'context', 'variational', 'static', 'wide', 'adaptive', 'none'"),
        (dict(action_loss="mae"), "action_loss is 'mae'; it must be one of 'mse', 'cross_entropy'"),
        (dict(policy_latent="mode"), "policy_latent is 'mode'; it must be one of 'sample', 'mean'"),
        (dict(similarity="euclidean"), "similarity is 'euclidean'; it must be one of 'embedding', 'observation'"),
        (dict(belief="wide", detach_belief=True), "leave detach_belief False"),
        (dict(history_length=0), "at least 1"),
        (dict(history_length=8.5), "integer"),
        (dict(keep_ratio=0.0), r"\(0, 1\]"),
        (dict(keep_ratio=1.5), r"\(0, 1\].*belief='variational' or 'static'"),
        (dict(keep_ratio=float("nan")), r"\(0, 1\]"),
        (dict(action_coef=-1.0), "action_coef"),
        (dict(kl_coef=-1.0), "kl_coef"),
        (dict(policy_kwargs=dict(latent_dim=0)), "latent_dim"),
        (dict(policy_kwargs=dict(embedding_dim=2.5)), "embedding_dim"),
        (dict(policy_kwargs=dict(share_features_extractor=False)), "share"),
    ],
)
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_nonsense_is_refused(algorithm, kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_model(algorithm=algorithm, **kwargs)


@pytest.mark.parametrize("name", ["action_coef", "kl_coef"])
def test_a_coefficient_that_is_no_number_is_refused(name):
    with pytest.raises(TypeError, match=f"{name} is '0.5'; it must be a number of at least 0, or a schedule"):
        make_model(**{name: "0.5"})


def test_cross_entropy_is_refused_for_numbers_and_for_them_alone():
    others = {"b": spaces.Discrete(2), "c": spaces.Box(-1, 1, (2,), np.float32), "d": spaces.Box(0, 1, (1,), np.float32)}
    kwargs: dict[str, Any] = dict(env_kwargs=dict(others=others), action_loss="cross_entropy")
    for belief in ("dynamic", "context", "variational", "static"):
        with pytest.raises(ValueError, match=r"those of c, d are numbers \(Box\); use action_loss='mse'"):
            make_model(belief=belief, **kwargs)
    for belief in ("wide", "none"):  # they predict nothing
        make_model(belief=belief, **kwargs)


def test_without_an_action_loss_each_belief_has_its_own(tmp_path):
    """That of the paper; of the adaptive one that with which it learns sooner (docs/results.md), where it can be computed."""
    numbers = {"b": spaces.Discrete(2), "c": spaces.Box(-1, 1, (2,), np.float32)}
    finite = {"b": spaces.Discrete(2), "c": spaces.MultiBinary(2)}
    for belief, others, expected in (
        ("dynamic", finite, "mse"),
        ("static", finite, "mse"),
        ("adaptive", finite, "cross_entropy"),
        ("adaptive", numbers, "mse"),
    ):
        kwargs: dict[str, Any] = dict(belief=belief, seed=0, env_kwargs=dict(others=others))
        unnamed, named = (make_model(**kwargs, **given).learn(2 * ROLLOUT) for given in ({}, dict(action_loss=expected)))
        assert same_parameters(unnamed, named) and unnamed.policy.action_loss == expected
        unnamed.save(tmp_path / "model")
        assert BeliefPPO.load(tmp_path / "model").policy.action_loss == expected


def test_without_a_belief_the_others_may_share_no_features():
    policy = make_model(belief="none", policy_kwargs=dict(share_features_extractor=False)).policy
    assert policy.pi_features_extractor is not policy.vf_features_extractor


@pytest.mark.parametrize("algorithm, buffer", [(BeliefPPO, "BeliefRolloutBuffer"), (MaskableBeliefPPO, "MaskableBeliefRoll")])
def test_foreign_policy_and_buffer_are_refused(algorithm, buffer):
    from stable_baselines3.common.buffers import RolloutBuffer
    from stable_baselines3.common.policies import ActorCriticPolicy

    with pytest.raises(TypeError, match=f"sb3_belief.belief_ppo.{buffer}"):
        make_model(algorithm=algorithm, rollout_buffer_class=RolloutBuffer)
    env = make_vec_env(AmongOthers, n_envs=1)
    with pytest.raises(ValueError, match=rf"belief_ppo\.{algorithm.policy_base.__name__}"):
        algorithm(ActorCriticPolicy, env, **SMALL)


def test_another_set_of_others_is_refused(tmp_path):
    model = make_model().learn(ROLLOUT)
    foreign = make_vec_env(AmongOthers, n_envs=1, env_kwargs=dict(others={"b": spaces.Discrete(3)}))
    with pytest.raises(ValueError, match="in this order"):
        model.set_env(foreign)
    model.save(tmp_path / "agent")
    with pytest.raises(ValueError, match="in this order"):
        BeliefPPO.load(tmp_path / "agent", env=foreign)
    model.set_env(make_vec_env(AmongOthers, n_envs=3))
    model.learn(ROLLOUT)


def test_info_that_lacks_the_others_is_refused():
    class Silent(AmongOthers):
        def _info(self):
            return {}

    with pytest.raises(ValueError, match="lacks 'others_actions'"):
        BeliefPPO("BeliefPolicy", make_vec_env(Silent), **SMALL).learn(ROLLOUT)

    class Short(AmongOthers):
        def _info(self):
            return {**super()._info(), "others_actions": np.zeros(3)}

    with pytest.raises(ValueError, match=r"\(3,\).*\(7,\)"):
        BeliefPPO("BeliefPolicy", make_vec_env(Short), **SMALL).learn(ROLLOUT)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_many_agents_are_refused_with_the_ways_that_work(algorithm):
    from mpe2 import simple_spread_v3

    for env in (simple_spread_v3.parallel_env(), simple_spread_v3.env()):
        with pytest.raises(TypeError, match=rf"(?s)Team\({algorithm.__name__}.*fixed partners"):
            algorithm("BeliefPolicy", env)
    with pytest.raises(TypeError, match=rf"Team\({algorithm.__name__}"):
        make_model(algorithm=algorithm).set_env(simple_spread_v3.parallel_env())


def test_others_with_actions_that_cannot_be_flattened_are_refused():
    with pytest.raises(ValueError, match=r"b has the action space.*Flatten its action space in the environment"):
        make_model(env_kwargs=dict(others={"b": spaces.Tuple([spaces.Discrete(2), spaces.Discrete(3)])}))
