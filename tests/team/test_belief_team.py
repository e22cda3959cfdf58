"""A team of BeliefPPO agents at the junction: learning, determinism, saving and rewards, all parts together."""

from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_belief import BeliefPPO, Team, make_team_env
from sb3_belief.belief import filled_rows

SMALL: dict[str, Any] = dict(n_steps=20, batch_size=80, n_epochs=2, history_length=60, keep_ratio=0.1)


def make_team(belief="dynamic", seed=0, **env_kwargs):
    """Return a small team in four copies of the easy junction."""
    env = make_team_env("traffic-junction-easy", n_envs=4, seed=seed, env_kwargs=env_kwargs)
    return Team(BeliefPPO, "BeliefPolicy", env, seed=seed, belief=belief, **SMALL)


def parameters(team):
    """Return copies of all tensors of all agents' policies by name."""
    return {
        f"{agent}.{name}": value.clone()
        for agent, model in team.agents.items()
        for name, value in model.policy.state_dict().items()
    }


def test_every_agent_learns_a_belief_of_its_own():
    team = make_team().learn(3 * 80)
    for agent, model in team.agents.items():
        assert list(model.others_action_spaces) == [name for name in team.possible_agents if name != agent]
        logged = model.logger.name_to_value
        assert logged["belief/first_log_ratio"] < 1e-5
        # The buffer holds the actions that were visible, of agents that were in play
        buffer = model.rollout_buffer
        blocks = buffer.others_actions.reshape(-1, 4, 2)
        np.testing.assert_array_equal(blocks.sum(axis=2), buffer.others_visible.astype(np.float32))
        assert not buffer.others_visible[~buffer.active].any()
        # The first entry of an observation says whether the slot has a car. The history holds only such steps
        history = filled_rows(model.policy.history)
        assert len(history.valid) > 0 and (history.observations[:, 0] == 1).all()
    first, second = (team.agents[agent].policy.belief.query.weight for agent in ("car_0", "car_1"))
    assert not th.equal(first, second)


def test_runs_are_deterministic():
    first, second = (parameters(make_team().learn(2 * 80)) for _ in range(2))
    assert first.keys() == second.keys() and all(th.equal(value, second[name]) for name, value in first.items())
    other = parameters(make_team(seed=1).learn(2 * 80))
    assert not all(th.equal(value, other[name]) for name, value in first.items())


@pytest.mark.parametrize("belief", ["dynamic", "none"])
def test_saved_team_goes_on(tmp_path, belief):
    team = make_team(belief).learn(80)
    team.save(tmp_path / "team")
    loaded = Team.load(tmp_path / "team.zip", env=make_team_env("traffic-junction-easy", n_envs=4, seed=0))
    before = parameters(team)
    assert all(th.equal(value, before[name]) for name, value in parameters(loaded).items())
    obs = make_team_env("traffic-junction-easy", n_envs=4, seed=5).reset()
    for agent, action in team.predict(obs, deterministic=True)[0].items():
        np.testing.assert_array_equal(action, loaded.predict(obs, deterministic=True)[0][agent])
    loaded.learn(80)
    assert not all(th.equal(value, before[name]) for name, value in parameters(loaded).items())


def test_with_the_team_reward_idle_slots_pass_it_on_to_those_who_earned_it():
    team = make_team("none", reward="team", arrival_rate=0.5)
    checked = 0
    team.learn(80)
    for model in team.agents.values():
        buffer = model.rollout_buffer
        values = buffer.values.reshape(4, 20).T  # After the update each copy's steps stand one after the other
        active, rewards = buffer.active.reshape(4, 20).T, buffer.rewards
        for copy in range(4):
            for step in range(18):
                if not active[step, copy] and not active[step + 1, copy]:
                    expected = rewards[step, copy] + model.gamma * values[step + 1, copy]
                    assert values[step, copy] == pytest.approx(expected, abs=1e-4)
                    checked += 1
    assert checked > 10


def test_a_joint_environment_is_refused_by_one_agent():
    with pytest.raises(TypeError, match=r"Team\(BeliefPPO"):
        BeliefPPO("BeliefPolicy", make_team_env("traffic-junction-easy"))
