"""What an agent with an adaptive belief remembers when it is deployed: of which copy, episode and step, and what is saved."""

from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from sb3_belief.belief.memory import DEPLOYED, valid_rows
from sb3_belief.belief_ppo import BeliefPPO
from tests.belief_ppo.helpers import ROLLOUT, SMALL, observations_of, same_parameters
from tests.belief_ppo.test_adaptive import ADAPTIVE, adaptive
from tests.belief_ppo.toy_envs import AmongOthers


def test_memories_differ_by_copy():
    """What one copy's partner did is told apart from what another's did."""
    model = adaptive().learn(2 * ROLLOUT)
    obs = observations_of(model, 1)
    policy = model.policy
    for copy in (0, 1):
        policy.remember(np.repeat(obs, 2, axis=0)[:1], {"b": np.array([copy]), "c": np.array([copy])}, copies=np.array([copy]))
    policy.restore_history(policy.history)
    first, second, third = policy.predict_others(np.repeat(obs, 3, axis=0)).rows
    length = int(policy.history.valid.sum())
    assert length - 2 in first[:3] and length - 1 not in first[:3]
    assert length - 1 in second[:3] and length - 2 not in second[:3]
    # Of a copy in which nobody was seen yet there is nothing
    assert (third[:3] == -1).all() and (third[3:] >= 0).any()


def test_an_agent_that_has_acted_in_one_copy_may_be_evaluated_in_many():
    model = adaptive().learn(2 * ROLLOUT)
    obs = observations_of(model, 1)
    model.policy.remember(obs, {"b": 1})
    rows = model.policy.predict_others(np.repeat(obs, 3, axis=0)).rows
    assert (rows == rows[0]).all() and int(model.policy.history.valid.sum()) - 1 in rows[0, :3]


def test_a_deployed_agent_remembers_steps_episodes_and_rewards():
    model = adaptive().learn(ROLLOUT)
    policy, before = model.policy, model.policy.history
    clock = policy.features_extractor.clock
    obs = observations_of(model, 3)
    seen = {"b": np.array([0, 1, 2])}
    policy.remember(obs, seen, own_actions=np.array([2, 0, 1]), rewards=np.array([0.5, 0.0, -1.0]))
    policy.end_episodes()
    policy.remember(obs[:1], {"c": 3})
    rows = valid_rows(policy.history)
    assert rows.stamps[-4:].tolist() == [
        *([clock + i, DEPLOYED, -1] for i in range(2)),
        # The last of its episode
        [clock + 2, DEPLOYED, -2],
        [clock + 3, DEPLOYED, clock + 3],
    ]
    assert rows.own[-4:].tolist() == [[0, 0, 1, 0.5], [1, 0, 0, 0], [0, 1, 0, -1], [0, 0, 0, 0]]
    assert rows.actions[-4:].argmax(dim=1).tolist() == [0, 1, 2, 6]
    # A step at which nobody was seen says nothing, but it has passed
    policy.remember(obs[:1], {"b": None})
    assert int(policy.history.valid.sum()) == len(rows.valid) and policy.features_extractor.clock == clock + 5
    # Single actions and rewards
    policy.remember(obs[:1], {"c": 0}, own_actions=2, rewards=0.25)
    assert valid_rows(policy.history).own[-1].tolist() == [0, 0, 1, 0.25]
    policy.restore_history(before)
    assert policy.features_extractor.clock == clock


def test_an_action_of_zeros_is_seen():
    model = adaptive(env_kwargs=dict(others={"b": spaces.MultiBinary(2), "c": spaces.Box(-1, 1, (1,), np.float32)}))
    policy, obs = model.policy, observations_of(model, 1)
    policy.remember(obs, {"b": np.zeros((1, 2))})
    policy.remember(obs, np.zeros((1, 3)), {"c": np.array([True]), "b": np.array([False])})
    assert int(policy.history.valid.sum()) == 2
    # Without a word on who was visible, rows of zeros say that nobody was
    policy.remember(obs, np.zeros((1, 3)))
    assert int(policy.history.valid.sum()) == 2


@pytest.mark.parametrize(
    "kwargs, message",
    [
        (dict(own_actions=np.zeros(2)), r"own_actions must be .* shape \(1,\)"),
        (dict(own_actions=[3]), r"own_actions has .*3.*, which is no action of Discrete\(3\)"),
        (dict(own_actions=[-1]), r"own_actions has .*-1"),
        (dict(own_actions=[1.7]), r"own_actions has .*1.7"),
        (dict(rewards=np.zeros((1, 1))), r"rewards must be .* shape \(1,\)"),
        (dict(rewards=np.array([np.nan])), r"rewards must be finite"),
        (dict(copies=np.zeros(2, dtype=int)), r"copies must be .* shape \(1,\)"),
        (dict(copies=np.array([-1])), r"copies must be"),
        (dict(acted=[1]), r"acted must be one truth value for each of the 1 steps"),
    ],
)
def test_what_cannot_be_remembered_is_refused(kwargs, message):
    model = adaptive().learn(ROLLOUT)
    before = model.policy.history
    with pytest.raises(ValueError, match=message):
        model.policy.remember(observations_of(model, 1), {"b": 1}, **kwargs)
    assert all(th.equal(a, b) for a, b in zip(before, model.policy.history, strict=True))


@pytest.mark.parametrize(
    "space, wrong",
    [
        (spaces.MultiDiscrete([2, 3]), [2, 0]),
        (spaces.MultiDiscrete([2, 3]), [-1, 0]),
        (spaces.MultiBinary(2), [5, 7]),
        (spaces.Box(-1, 1, (2,), np.float32), [0, np.inf]),
    ],
)
def test_no_action_of_another_space_is_remembered_unless_the_agent_did_nothing(space, wrong):
    model = adaptive(env_kwargs=dict(action_space=space))
    obs = observations_of(model, 1)
    with pytest.raises(ValueError, match="own_actions"):
        model.policy.remember(obs, {"b": 1}, own_actions=np.array(wrong))
    nothing = np.full(2, np.nan) if isinstance(space, spaces.Box) else np.array(wrong)
    model.policy.remember(obs, {"b": 1}, own_actions=nothing, acted=np.array([False]))
    assert not valid_rows(model.policy.history).own.any()
    with pytest.raises(ValueError, match="rewards must be finite numbers"):
        model.policy.remember(obs, {"b": 1}, rewards=np.array(["one"]))
    # Those beyond its bounds are clipped by an environment
    fits = [2.0, 0.0] if isinstance(space, spaces.Box) else [1, 1]
    model.policy.remember(obs, {"b": 1}, own_actions=np.array(fits))
    expected = [0, 1, 0, 1, 0, 0] if isinstance(space, spaces.MultiDiscrete) else [*fits, 0]
    assert valid_rows(model.policy.history).own[-1].tolist() == expected


def test_copies_are_numbers_and_each_is_there_once():
    policy, obs = adaptive().policy, observations_of(adaptive(), 2)
    with pytest.raises(ValueError, match="copies must each be another one"):
        policy.remember(obs, {"b": np.array([0, 1])}, copies=np.array([1, 1]))
    policy.remember(obs, {"b": np.array([0, 1])}, copies=np.array([1, 0], dtype=np.uint8))
    for wrong in ([-1], 0, [0.5], "all"):
        with pytest.raises(ValueError, match="copies must be a list of integers"):
            policy.end_episodes(wrong)
    assert valid_rows(policy.history).stamps[:, 2].tolist() == [-1, -1]
    policy.end_episodes([1])
    assert valid_rows(policy.history).stamps[:, 1:].tolist() == [[DEPLOYED - 1, -2], [DEPLOYED, -1]]


def test_own_actions_are_remembered_as_the_environment_got_them():
    got = []

    class Keeps(AmongOthers):
        def step(self, action):
            got.append(np.array(action))
            return super().step(action)

    env = make_vec_env(Keeps, n_envs=1, env_kwargs=dict(action_space=spaces.Box(0, 10, (2,), np.float32), visible=1.0))
    model = BeliefPPO(
        "BeliefPolicy", env, use_sde=True, **{**SMALL, **ADAPTIVE, "policy_kwargs": {"squash_output": True, "latent_dim": 4}}
    )
    model.learn(SMALL["n_steps"])
    history: Any = model.policy.history
    rows = valid_rows(history)
    np.testing.assert_allclose(rows.own[:, :2], np.array(got)[-len(rows.own) :], rtol=1e-5)


def test_time_passes_in_rollouts_without_an_update():
    model = adaptive(env_kwargs=dict(inactive=1))
    for clock in (1, 2):
        model.learn(ROLLOUT, reset_num_timesteps=False)
        assert model.policy.features_extractor.clock == clock * SMALL["n_steps"]

    class Stops(BaseCallback):
        def _on_step(self):
            return self.n_calls < 5

    model.learn(ROLLOUT, callback=Stops(), reset_num_timesteps=False)
    # Of the rollout that was stopped four steps are in the buffer
    assert model.policy.features_extractor.clock == 2 * SMALL["n_steps"] + 4


def test_nothing_else_is_remembered_in_a_rollout_of_the_training():
    """The update would attend to other rows than acting did."""
    model = adaptive()

    class Remembers(BaseCallback):
        def _on_step(self):
            model.policy.remember(observations_of(model, 1), {"b": 1})
            return True

    with pytest.raises(ValueError, match="in a rollout of its training"):
        model.learn(ROLLOUT, callback=Remembers())
    model.policy.remember(observations_of(model, 1), {"b": 1})
    assert len(valid_rows(model.policy.history).valid) == 1


@pytest.mark.parametrize("ends", [False, True])
def test_a_saved_model_goes_on_as_it_would_have(tmp_path, ends):
    model = adaptive(row_features=["age", "episode", "copy"], history_dropout=0.1).learn(2 * ROLLOUT)
    for _ in range(2):
        # Saved in the middle of an episode, or between two; after a step in which nobody was seen
        model.policy.remember(observations_of(model, 3), {"b": np.array([0, 1, 2])}, copies=np.arange(3))
        model.policy.remember(observations_of(model, 1), {}, copies=np.zeros(1, dtype=int))
        model.policy.end_episodes(np.arange(2 + ends))
    model.save(tmp_path / "model.zip")
    loaded = BeliefPPO.load(tmp_path / "model.zip", device="cpu")
    assert same_parameters(model, loaded)
    assert model.policy.options.row_features == ("age", "episode", "copy") and loaded.policy.options == model.policy.options
    obs = observations_of(model, 4)
    extractors: list[Any] = [each.policy.features_extractor for each in (model, loaded)]
    there, here = (each.present_stamps(4) for each in extractors)
    assert th.equal(there, here) and there[2, 2] == (there[1, 2] if ends else -1)
    assert np.array_equal(model.predict(obs, deterministic=True)[0], loaded.predict(obs, deterministic=True)[0])
    for name, expected in model.policy.predict_others(obs).actions.items():
        assert np.array_equal(expected, loaded.policy.predict_others(obs).actions[name])
