"""MaskableBeliefPPO: the same belief on sb3-contrib's MaskablePPO, alone and in a Team."""

from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib.common.maskable.evaluation import evaluate_policy
from sb3_contrib.common.maskable.utils import get_action_masks
from stable_baselines3.common.env_util import make_vec_env

from sb3_belief import Team, make_team_env
from sb3_belief.belief_ppo import MaskableBeliefPPO, MaskableBeliefRolloutBuffer
from tests.belief_ppo.helpers import ROLLOUT, SMALL, VARIANTS, Watch, make_model, observations_of
from tests.belief_ppo.toy_envs import MaskedAmongOthers, choices_of
from tests.team.toy_envs import MaskedEnv

ACTIONS: dict[str, spaces.Space] = {
    "discrete": spaces.Discrete(4),
    "multi-discrete": spaces.MultiDiscrete([3, 4]),
    "multi-binary": spaces.MultiBinary(3),
}


def chosen(space: spaces.Space, actions: np.ndarray, masks: np.ndarray) -> np.ndarray:
    """Whether the mask allowed each component of each action."""
    result, start = [], 0
    actions = actions.reshape(len(masks), -1).astype(int)
    for component, n in enumerate(choices_of(space)):
        result.append(masks[np.arange(len(masks)), start + actions[:, component]])
        start += n
    return np.stack(result)


@pytest.mark.parametrize("actions", ACTIONS)
def test_masks_hold_in_rollout_and_update_alike(actions):
    space = ACTIONS[actions]
    model = make_model(algorithm=MaskableBeliefPPO, env_kwargs=dict(action_space=space), learning_rate=1e-2)
    masks: list[np.ndarray] = []
    in_update: list[tuple[bytes, bytes]] = []
    in_rollout: list[tuple[bytes, bytes]] = []

    def look(model):
        buffer = model.rollout_buffer
        assert isinstance(buffer, MaskableBeliefRolloutBuffer)
        flat = buffer.action_masks.reshape(ROLLOUT, -1).astype(bool)
        masks.append(flat)
        assert chosen(space, buffer.actions.reshape(ROLLOUT, -1), flat).all()
        in_rollout.extend(
            (o.tobytes(), m.tobytes()) for o, m in zip(buffer.observations.reshape(ROLLOUT, -1), flat, strict=True)
        )

    evaluate = model.policy.evaluate_actions

    def watched(obs, actions, action_masks):
        values, log_prob, entropy = evaluate(obs, actions, action_masks=action_masks)
        if log_prob.requires_grad:
            given = np.asarray(action_masks).reshape(len(obs), -1).astype(bool)
            in_update.extend((o.tobytes(), m.tobytes()) for o, m in zip(obs.numpy(), given, strict=True))
            # Impossible in the distribution too, not merely never drawn
            probabilities = model.policy.get_distribution(obs, action_masks=action_masks)
            assert chosen(space, np.asarray(probabilities.sample()), given).all()
        return values, log_prob, entropy

    model.policy.evaluate_actions = watched
    # The environment raises where an impossible action is done
    model.learn(2 * ROLLOUT, callback=Watch(look))
    assert sorted(in_update) == sorted(in_rollout * SMALL["n_epochs"])
    assert 0.1 < np.mean(masks) < 0.95
    assert model.logger.name_to_value["belief/first_log_ratio"] < 1e-5


@pytest.mark.parametrize("actions", ACTIONS)
@pytest.mark.parametrize("belief", ["dynamic", "static", "none"])
def test_masked_actions_are_never_predicted(tmp_path, belief, actions):
    space = ACTIONS[actions]
    model = make_model(algorithm=MaskableBeliefPPO, env_kwargs=dict(action_space=space), belief=belief).learn(ROLLOUT)
    model.save(tmp_path / "agent")
    loaded = MaskableBeliefPPO.load(tmp_path / "agent", device="cpu")
    rng, obs = np.random.default_rng(0), observations_of(model, 60)
    masks = np.concatenate(
        [np.eye(n, dtype=bool)[rng.integers(n, size=60)] | (rng.random((60, n)) < 0.3) for n in choices_of(space)], axis=1
    )
    for deterministic in (True, False):
        found = []
        for each in (model, loaded):
            th.manual_seed(0)
            found.append(each.predict(obs, deterministic=deterministic, action_masks=masks)[0])
        assert chosen(space, found[0], masks).all()
        np.testing.assert_array_equal(found[0], found[1])
    assert not chosen(space, model.predict(obs)[0], masks).all()  # without the masks some would be done


def test_sb3_contribs_evaluation_takes_it():
    model = make_model(algorithm=MaskableBeliefPPO).learn(ROLLOUT)
    env = make_vec_env(MaskedAmongOthers, n_envs=2, seed=3)
    rewards, lengths = evaluate_policy(model, env, n_eval_episodes=4, return_episode_rewards=True, warn=False)
    assert isinstance(lengths, list) and lengths == [7] * 4 and np.isfinite(rewards).all()
    env.reset()
    assert get_action_masks(env).shape == (2, 3)


def test_masking_can_be_switched_off():
    env = make_vec_env(MaskedAmongOthers, n_envs=1)
    kwargs: dict[str, Any] = dict(SMALL, n_steps=56)
    with pytest.raises(ValueError, match="is impossible at step"):
        MaskableBeliefPPO("BeliefPolicy", env, **kwargs).learn(56, use_masking=False)


@pytest.mark.parametrize("inactive", [0, 2])
@pytest.mark.parametrize("belief", VARIANTS)
def test_every_variant_learns_with_masks(belief, inactive):
    model = make_model(algorithm=MaskableBeliefPPO, belief=belief, env_kwargs=dict(inactive=inactive)).learn(2 * ROLLOUT)
    assert model.logger.name_to_value["belief/first_log_ratio"] < 1e-5
    rows = sum(len(samples.action_masks) for samples in model.rollout_buffer.get(16))
    assert rows == model.rollout_buffer.active.sum() and (rows < ROLLOUT) == (inactive == 2)


# -- in a Team ---------------------------------------------------------------------------------------------------------

TEAM: dict[str, Any] = dict(n_steps=16, batch_size=16, n_epochs=2, history_length=40, keep_ratio=0.2, device="cpu")


def test_masks_reach_each_model_through_a_team(tmp_path):
    env = make_team_env(lambda: MaskedEnv(3), n_envs=2, seed=0)  # which raises where an impossible action is done
    team: Any = Team(MaskableBeliefPPO, "BeliefPolicy", env, seed=0, **TEAM)
    team.learn(3 * 32)
    for agent in ("agent_0", "agent_1"):
        buffer = team.agents[agent].rollout_buffer
        masks = buffer.action_masks.reshape(32, 3).astype(bool)
        assert (masks.sum(axis=1) == 1).all() and masks.any(axis=0).all()  # one at a time is possible, in turn
        assert chosen(spaces.Discrete(3), buffer.actions, masks).all()
    assert team.agents["agent_2"].rollout_buffer.action_masks.all()
    for model in team.agents.values():
        assert model.policy.history.valid.all() and model.policy.layout.n_others == 2
    team.save(tmp_path / "team")
    again: Any = Team.load(tmp_path / "team", env=env)
    again.learn(32)
    again.agents["agent_1"].save(tmp_path / "agent_1")
    alone = MaskableBeliefPPO.load(tmp_path / "agent_1", device="cpu")
    obs = np.zeros((1, 2), dtype=np.float32)
    for action in range(3):
        mask = np.arange(3) == action
        assert alone.predict(obs, action_masks=mask[None])[0] == action


def test_traffic_junction_with_its_masks():
    env = make_team_env("traffic-junction-easy", n_envs=2, seed=0)
    team: Any = Team(MaskableBeliefPPO, "BeliefPolicy", env, seed=0, **TEAM)
    team.learn(4 * 32)
    seen = 0
    for model in team.agents.values():
        buffer = model.rollout_buffer
        masks = buffer.action_masks.reshape(32, -1).astype(bool)
        assert chosen(model.action_space, buffer.actions, masks).all()
        seen += int((~masks).sum())
        if buffer.active.any():
            assert model.logger.name_to_value["belief/first_log_ratio"] < 1e-5
    assert seen > 0
