"""What is logged of a belief."""

import numpy as np
import pytest
import torch as th

from sb3_belief import Team, make_team_env
from sb3_belief.belief.layout import ActionLayout
from sb3_belief.belief_ppo import algorithm, diagnostics
from sb3_belief.belief_ppo.buffers import BeliefMinibatch
from sb3_belief.zoo.config import load_config
from tests.belief_ppo.helpers import EVERY, ROLLOUT, make_model, same_parameters

ALWAYS = {"visible_fraction", "fusion_ratio", "first_log_ratio", "history_gain"}
PREDICTING = {"action_loss", "accuracy", "base_rate", "history_gain_rare"}
NAMES = {
    "dynamic": ALWAYS | PREDICTING | {"kl", "attention_entropy"},
    "context": ALWAYS | PREDICTING | {"attention_entropy"},
    "variational": ALWAYS | PREDICTING | {"kl"},
    "adaptive": ALWAYS | PREDICTING | {"attention_entropy"},
    "static": ALWAYS | PREDICTING,
    "wide": ALWAYS,
    "none": set(),
}


def measured_of(model):
    values = model.logger.name_to_value
    return {name.removeprefix("belief/"): value for name, value in values.items() if name.startswith("belief/")}


def test_diagnostics_measure_what_they_say():
    model = make_model(history_length=400, n_steps=100, batch_size=100, learning_rate=3e-3, n_epochs=10)
    model.learn(3 * 300)
    measured = measured_of(model)
    assert set(measured) == {
        *("action_loss", "kl", "accuracy", "base_rate", "history_gain", "history_gain_rare"),
        *("attention_entropy", "fusion_ratio", "visible_fraction", "first_log_ratio"),
    }
    # The others act at random: 3 and 4 actions, seen six times out of ten, nothing to predict
    assert measured["visible_fraction"] == pytest.approx(0.6, abs=0.06)
    assert measured["base_rate"] == pytest.approx((1 / 3 + 1 / 4) / 2, abs=0.08)
    assert measured["accuracy"] <= measured["base_rate"] + 0.08
    assert abs(measured["history_gain"]) < 0.05
    assert 0 < measured["attention_entropy"] <= np.log(40) + 1e-5
    fusion = model.policy.mlp_extractor
    belief = sum(layer.weight[:, -64:].abs().sum() for layer in (fusion.fuse_pi, fusion.fuse_vf))
    every = sum(layer.weight.abs().sum() for layer in (fusion.fuse_pi, fusion.fuse_vf))
    assert fusion.belief_share() == pytest.approx((belief / every).item(), rel=1e-5)


@pytest.mark.parametrize("kind, belief", EVERY)
def test_each_variant_logs_what_it_has(belief, kind):
    model = make_model(belief=belief, algorithm=kind)
    for iteration in range(3):
        model.learn(ROLLOUT, reset_num_timesteps=False)
        measured = measured_of(model)
        assert set(measured) == NAMES[belief] and all(np.isfinite(value) for value in measured.values())
        if belief == "none":
            continue
        # By construction, not by luck: nothing of a history that is not there can be shuffled
        without_history = belief not in ("dynamic", "context", "adaptive") or (iteration == 0 and belief != "adaptive")
        assert (measured["history_gain"] == 0) == without_history
        assert (measured.get("history_gain_rare", 0.0) == 0) == without_history
        if "attention_entropy" in measured:
            # The adaptive one attends to the first rollout already
            assert (measured["attention_entropy"] == 0) == (iteration == 0 and belief != "adaptive")
        assert measured["first_log_ratio"] < 1e-5


def test_the_measured_losses_are_those_that_are_trained():
    model = make_model(n_epochs=1, batch_size=ROLLOUT, action_coef=0.25, kl_coef=0.125)
    model.learn(ROLLOUT)
    losses, belief_loss = [], model.policy.belief_loss

    def watched(belief, minibatch):
        losses.append(belief_loss(belief, minibatch))
        return losses[-1]

    model.policy.belief_loss = watched
    model.learn(ROLLOUT)
    measured = measured_of(model)
    # The last one: the first is the measurement's own. 42 rows are all measured, and trained in one minibatch
    assert losses[-1].item() == pytest.approx(0.25 * measured["action_loss"] + 0.125 * measured["kl"], rel=1e-5)


@pytest.mark.parametrize("kwargs", [{}, dict(belief="adaptive", belief_replay=2, history_dropout=0.1)], ids=str)
def test_measuring_changes_nothing(monkeypatch, kwargs):
    measured = make_model(**kwargs).learn(3 * ROLLOUT)
    monkeypatch.setattr(algorithm, "measure_belief", lambda policy, buffer: {})
    unmeasured = make_model(**kwargs).learn(3 * ROLLOUT)
    assert measured_of(measured) and not measured_of(unmeasured)
    assert same_parameters(measured, unmeasured)


def test_who_did_something_rare():
    layout = ActionLayout([[3], [2, 2], [1]], ["categorical", "categorical", "number"])
    a = np.eye(3)[[0, 0, 1, 2, 2]]
    # The first component is 0 but once, the second 1 but once
    b = np.concatenate([np.eye(2)[[0, 0, 1, 0, 0]], np.eye(2)[[1, 0, 1, 1, 1]]], axis=1)
    actions = th.as_tensor(np.concatenate([a, b, np.zeros((5, 1))], axis=1), dtype=th.float32)
    visible = th.tensor([[True, True, True]] * 4 + [[False, True, True]])
    minibatch = BeliefMinibatch(th.zeros(5, 0), th.zeros(5, 0, dtype=th.long), actions, visible)
    rare = diagnostics._did_the_rare(minibatch, layout)
    # What nobody saw does not count, or 2 would be as frequent as 0 with a; numbers are neither frequent nor rare
    assert rare.tolist() == [
        [False, False, False],
        [False, True, False],
        [True, True, False],
        [True, False, False],
        [False, False, False],
    ]


def test_a_type_that_shows_in_a_few_steps_shows_in_those():
    env = make_team_env("aisle-sides", n_envs=20, seed=1)
    config = load_config("belief_ppo", "aisle-sides")
    team = Team(config.algo_class, config.policy, env, seed=1, **config.algo_kwargs).learn(20 * 800)
    measured = measured_of(team.agents["robot_0"])
    # The others are in the middle of the aisle in nine steps out of ten, whatever the convention is
    assert measured["base_rate"] > 0.75
    assert measured["history_gain_rare"] > 3 * measured["history_gain"] > 0
