"""What the adapters to SMAC and SMACv2 do when the connection to StarCraft II is lost."""

from functools import partial

import numpy as np
import pytest

from tests.envs.adapters.smac_helpers import MAKERS, hide, make, make_team_env, near_the_limit, random_play, still


@pytest.mark.parametrize("maker", MAKERS)
@pytest.mark.parametrize("first_battle", [True, False])
def test_a_lost_connection_truncates_and_the_next_battle_begins(faults, maker, first_battle):
    env = maker()
    env.reset(seed=0)
    generator = np.random.default_rng(0)
    if not first_battle:
        near_the_limit(env, 1)
        random_play(env, generator)
        env.reset()
    observations = random_play(env, generator)[0]
    faults.lost_steps.add(faults.n_steps + 1)
    calls = faults.obs_calls
    with pytest.warns(UserWarning, match="lost its connection"):
        last, rewards, terminations, truncations, infos = random_play(env, generator)
    assert all(truncations.values()) and not any(terminations.values()) and not env.agents
    # The units of the closed game are not queried, the battle does not count as lost, and no unit is reported as seen
    assert faults.obs_calls == calls
    for agent in env.possible_agents:
        np.testing.assert_array_equal(last[agent], observations[agent])
        assert "is_success" not in infos[agent] and rewards[agent] == 0.0
    assert not any(row.any() for row in env.visibility().values())
    env.reset()
    random_play(env, generator)
    assert env.agents and len(faults.running()) == 1


def test_a_lost_connection_under_the_vectoriser(faults):
    env = make_team_env(partial(make, "3m"), n_envs=2, seed=0)
    env.reset()
    faults.lost_steps.add(2)
    stop = {agent: np.ones(2, dtype=int) for agent in env.possible_agents}
    with pytest.warns(UserWarning, match="lost its connection"):
        _, _, dones, infos = env.step(stop)
    assert dones.tolist() == [False, True]
    assert infos[1]["TimeLimit.truncated"] is True and infos[1]["truncated"].all() and infos[1]["is_success"] is False
    assert env.step(stop)[2].tolist() == [False, False]


def test_no_starcraft_is_left_behind(faults):
    env = make("3m")
    env.reset(seed=0)
    # SMAC itself would launch another process at each reset before its first battle is over
    for _ in range(3):
        env.step(still(env))
        env.reset()
        assert len(faults.running()) == 1
    hide(env)
    near_the_limit(env, 1)
    env.step(still(env))
    launched = len(faults.processes)
    env.reset()
    env.step(still(env))
    env.reset()
    assert len(faults.processes) == launched, "from then on it goes on with the one that runs"
    env.reset(seed=5)
    assert len(faults.running()) == 1 and faults.running()[0].seed == 5
    env.close()
    env.close()
    assert not faults.running()
    env.reset()
    assert len(faults.running()) == 1


@pytest.mark.parametrize("maker", MAKERS)
def test_connections_lost_at_the_beginning_of_a_battle(faults, maker):
    env = maker()
    faults.lost_resets = 2
    env.reset(seed=0)
    assert all(unit.health > 0 for unit in env.game.agents.values()) and len(faults.running()) == 1
    near_the_limit(env, 1)
    env.step(still(env))
    faults.lost_resets = 1
    env.reset()
    assert env.game._episode_steps == 0 and len(faults.running()) == 1
    faults.lost_resets = 3
    with pytest.raises(RuntimeError, match="3 battles"):
        env.reset()


def test_an_error_that_is_no_lost_connection_is_raised(faults, monkeypatch):
    env = make("3m")
    monkeypatch.setattr(env.game, "init_units", lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        env.reset()
