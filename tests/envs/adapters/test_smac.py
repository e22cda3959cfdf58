"""The adapters to SMAC and SMACv2, tested against fakes that have the packages' interfaces and faults."""

import copy
import random
import warnings
from functools import partial
from typing import Any

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test

from sb3_belief import BeliefPPO, MaskableBeliefPPO, team
from sb3_belief.envs.adapters import smacv2
from tests.envs.adapters.smac_helpers import MAKERS, hide, make, make_team_env, make_v2, near_the_limit, random_play, still
from tests.envs.adapters.tuple_helpers import check_advantages, train_save_load_evaluate

Team: Any = team.Team


@pytest.mark.parametrize("maker", MAKERS)
def test_pettingzoo_interface(faults, maker):
    env = maker()
    assert not faults.processes, "StarCraft starts when it is needed"
    with warnings.catch_warnings():
        # PettingZoo's test samples actions without masks, and this environment refuses illegal ones
        warnings.simplefilter("ignore")
        with pytest.raises(ValueError, match="cannot do action"):
            parallel_api_test(env, num_cycles=30)
    observations, infos = env.reset(seed=0)
    for agent in env.possible_agents:
        assert env.observation_space(agent).contains(observations[agent])
        assert infos[agent]["action_mask"].shape == (env.action_space(agent).n,)
        assert infos[agent]["action_mask"].dtype == bool
    assert not any(row.any() for row in env.visibility().values())
    env.close()
    assert not faults.running()


@pytest.mark.parametrize("maker", [MAKERS[0], partial(make_v2, "terran_5_vs_5", conic_fov=True)])
def test_no_illegal_action_is_sent_in_10000_steps(faults, maker):
    env = maker()
    generator = np.random.default_rng(0)
    env.reset(seed=0)
    ends = 0
    for _ in range(10_000):
        # Dead units may choose any action, because it is not sent to the game
        dead = {a: int(generator.integers(env.n_actions)) for i, a in enumerate(env.possible_agents) if env._masks[i, 0]}
        random_play(env, generator, dead)
        if not env.agents:
            env.reset()
            ends += 1
    assert len(faults.sent) == 10_000 and ends > 5
    dead_orders = 0
    for available, actions in faults.sent:
        for possible, action in zip(available, actions, strict=True):
            assert possible[action] == 1 and type(action) is int
            dead_orders += possible[0]
    assert dead_orders > 0
    assert len(faults.running()) == 1


def test_who_dies_is_inactive_and_is_given_the_teams_reward(faults):
    env = make("2s3z")
    generator = np.random.default_rng(1)
    env.reset(seed=1)
    rewarded = 0
    for _ in range(600):
        alive = [env.game.get_unit_by_id(i).health > 0 for i in range(5)]
        observations, rewards, terminations, truncations, infos = random_play(env, generator)
        assert [infos[agent]["active"] for agent in env.possible_agents] == alive
        assert len(set(rewards.values())) == 1 and env.team_reward(rewards) == rewards["agent_3"]
        assert all("life_end" not in info for info in infos.values())
        for i, agent in enumerate(env.possible_agents):
            assert infos[agent].get("next_active", True) == (env.game.get_unit_by_id(i).health > 0)
            if env.game.get_unit_by_id(i).health <= 0:
                assert not observations[agent].any() and not env.visibility()[agent].any()
                assert infos[agent]["action_mask"].tolist() == [k == 0 for k in range(11)]
            rewarded += not alive[i] and rewards[agent] > 0
        if not env.agents:
            assert set(terminations.values()) | set(truncations.values()) == {True, False}
            env.reset()
        else:
            assert env.agents == env.possible_agents
    assert rewarded > 0


@pytest.mark.parametrize("won", [True, False])
def test_a_battle_that_is_over_terminates(faults, won):
    env = make("3m")
    env.reset(seed=0)
    hide(env)
    for unit in (env.game.enemies if won else env.game.agents).values():
        unit.health = 0.0
    # The masks as they were before the units fell
    env._masks[:, 0] = not won
    # A battle that is over terminates even at the step limit
    near_the_limit(env, 1)
    _, rewards, terminations, truncations, infos = env.step(still(env))
    assert all(terminations.values()) and not any(truncations.values()) and not env.agents
    assert {info["is_success"] for info in infos.values()} == {won}
    assert rewards["agent_0"] == (10.0 if won else 0.0)
    with pytest.raises(ValueError, match=r"call reset\(\)"):
        env.step(still(env))


@pytest.mark.parametrize("maker", MAKERS)
def test_the_step_limit_truncates(faults, maker):
    env = maker()
    env.reset(seed=0)
    hide(env)
    near_the_limit(env, 2)
    assert not any(env.step(still(env))[3].values())
    _, _, terminations, truncations, infos = env.step(still(env))
    assert not any(terminations.values()) and all(truncations.values()) and not env.agents
    assert {info["is_success"] for info in infos.values()} == {False}


def battle_of_five_steps(is_won):
    """Return a battle in which the sides never meet, and whose fifth step either is won or reaches the limit."""
    env = make("3m")
    reset, step, steps = env.reset, env.step, [0]

    def begin(*args, **kwargs):
        observations, infos = reset(*args, **kwargs)
        hide(env)
        env._masks = np.array(env.game.get_avail_actions(), dtype=bool)
        for i, agent in enumerate(env.possible_agents):
            infos[agent]["action_mask"] = env._masks[i]
        near_the_limit(env, 10 if is_won else 5)
        steps[0] = 0
        return observations, infos

    def go_on(actions):
        steps[0] += 1
        for enemy in env.game.enemies.values() if is_won and steps[0] == 5 else ():
            enemy.health = 0.0
        return step(actions)

    env.reset, env.step = begin, go_on
    return env


@pytest.mark.parametrize("is_won", [True, False])
def test_limits_are_bootstrapped_and_battles_that_are_over_are_not(faults, is_won):
    ends = check_advantages(partial(battle_of_five_steps, is_won), lambda last: is_won, 16, MaskableBeliefPPO)
    assert len(ends) == 3 * 2 * 3  # Agents, copies and battles


def test_reset_of_smacv2_that_returns_nothing(faults):
    env = make_v2("terran_5_vs_5")
    faults.missing_units = 2
    observations, infos = env.reset(seed=0)
    assert faults.missing_units == 0
    for i, agent in enumerate(env.possible_agents):
        np.testing.assert_array_equal(observations[agent], env.game.get_obs_agent(i).astype(np.float32))
        assert infos[agent]["action_mask"].any()


@pytest.mark.parametrize("maker", MAKERS)
def test_observations_are_asked_for_once_per_step(faults, maker):
    env = maker()
    env.reset(seed=0)
    assert faults.obs_calls == 1
    for n in range(2, 6):
        random_play(env, np.random.default_rng(n))
        assert faults.obs_calls == n


def visible_from_positions(env):
    """
    Compute from positions, sight ranges and cones which unit sees which.

    :return: Bool ``[n_agents, n_agents]``, and the number of entries in which the package's own matrix differs
    """
    game = env.game
    n_agents = len(env.possible_agents)
    sees = np.zeros((n_agents, n_agents), dtype=bool)
    for i, unit in game.agents.items():
        for j, other in game.agents.items():
            dx, dy = other.pos.x - unit.pos.x, other.pos.y - unit.pos.y
            near = np.hypot(dx, dy) < game.unit_sight_range(i)
            if getattr(game, "conic_fov", False):
                look_x, look_y = game.fov_directions[i]
                cosine = (dx * look_x + dy * look_y) / max(np.hypot(dx, dy), 1e-9)
                near = near and cosine > np.cos(np.pi / game.n_fov_actions)
            sees[i, j] = i != j and near and unit.health > 0 and other.health > 0
    return sees, int((game.get_visibility_matrix()[:, :n_agents] != sees).sum())


@pytest.mark.parametrize(
    ("maker", "matrix_is_right"),
    [
        (partial(make, "3m"), True),
        (partial(make, "2s3z"), True),
        (partial(make, "2s3z", obs_last_action=True), True),
        (partial(make_v2, "zerg_10_vs_11", use_unit_ranges=False), True),
        # Units of different sight ranges, and units that see in one direction only
        (partial(make_v2, "zerg_10_vs_11"), False),
        (partial(make_v2, "protoss_10_vs_10", conic_fov=True), False),
    ],
)
def test_visibility(faults, maker, matrix_is_right):
    env = maker()
    generator = np.random.default_rng(2)
    env.reset(seed=2)
    n_agents = len(env.possible_agents)
    hidden = differences = ends = 0
    for _ in range(400):
        # Each unit walks in a direction of its own, so that they lose sight of each other
        apart = {a: 2 + i % 4 for i, a in enumerate(env.possible_agents) if env._masks[i, 2 + i % 4]}
        random_play(env, generator, apart if generator.random() < 0.5 else None)
        sees, wrong = visible_from_positions(env)
        visible = env.visibility()
        for i, agent in enumerate(env.possible_agents):
            assert visible[agent].tolist() == np.delete(sees[i], i).tolist()
        alive = sum(unit.health > 0 for unit in env.game.agents.values())
        hidden += alive * (alive - 1) - sees.sum()
        differences += wrong
        if not env.agents:
            # The last step of an episode is covered too. Its positions are gone after the reset
            ends += sees.any() or n_agents == 3
            env.reset()
    assert hidden > 0
    assert (differences == 0) == matrix_is_right


def test_observations(faults):
    plain, timed, acted = make("2s3z"), make("2s3z", obs_timestep_number=True), make("2s3z", obs_last_action=True)
    timed_v2 = make_v2("protoss_5_vs_5", obs_timestep_number=True)
    for env in (plain, timed, acted, timed_v2):
        observations, _ = env.reset(seed=3)
        for agent, space in env.observation_spaces.items():
            assert observations[agent].shape == space.shape and observations[agent].dtype == np.float32
    # SMAC's observations have one entry more than get_obs_size() says, since the time step is appended as well
    assert timed.width == plain.width + 2 and timed.game.get_obs_size() == plain.width + 1
    assert acted.width == plain.width + 4 * 11
    assert not plain.game.obs_last_action


def test_seeds(faults):
    def lives(env, seed, n_steps=150):
        generator = np.random.default_rng(0)
        rows = [np.stack(list(env.reset(seed=seed)[0].values()))]
        for _ in range(n_steps):
            rows.append(np.stack(list(random_play(env, generator)[0].values())))
            if not env.agents:
                rows.append(np.stack(list(env.reset()[0].values())))
        return np.array(rows)

    for maker in MAKERS:
        first, second = maker(), maker()
        random.seed(1)
        life = lives(first, 7)
        random.seed(2)
        np.random.seed(2)
        expected_random, expected_numpy = random.Random(2).random(), np.random.RandomState(2).random()
        np.testing.assert_array_equal(life, lives(second, 7))
        # The seed also decides everything in an environment that has been used before
        np.testing.assert_array_equal(life, lives(second, 7))
        assert not np.array_equal(life[0], lives(second, 8, 0)[0])
        if maker.func is make_v2:
            # The process's own generators are as if nothing had been drawn from them
            assert random.random() == expected_random and np.random.random() == expected_numpy
        first.reset()
        second.reset()


def test_scenarios_of_smacv2(faults):
    assert len(smacv2.names()) == 15 and smacv2.names()[:3] == ["protoss_5_vs_5", "terran_5_vs_5", "zerg_5_vs_5"]
    for name in smacv2.names():
        env = make_v2(name)
        race, n_units, _, n_enemies = name.split("_")
        assert len(env.possible_agents) == int(n_units) and env.n_actions == 6 + int(n_enemies)
        assert env.game.env.map_name == f"10gen_{race}"
        assert env.game.use_unit_ranges and env.game.obs_own_pos
    config = smacv2.scenario("terran_5_vs_5")["capability_config"]
    before = copy.deepcopy(config)
    env = make_v2("10gen_terran", capability_config=config)
    env.reset(seed=0)
    env.reset(seed=1)
    assert config == before, "the package writes into copies only"


def test_wrong_use(faults):
    with pytest.raises(ValueError, match="'4m'; there are 3m, 2s3z"):
        make("4m")
    with pytest.raises(ValueError, match="'terran'; there are protoss_5_vs_5"):
        make_v2("terran")
    for maker in (make, make_v2):
        name = "3m" if maker is make else "zerg_5_vs_5"
        with pytest.raises(ValueError, match="no argument 'seed'"):
            maker(name, seed=3)
        with pytest.raises(ValueError, match="no argument 'continuing_episode'"):
            maker(name, continuing_episode=False)
        with pytest.raises(ValueError, match="render_mode='ansi'"):
            maker(name, render_mode="ansi")
    with pytest.raises(ValueError, match="obs_starcraft"):
        make_v2("zerg_5_vs_5", obs_starcraft=False)
    with pytest.raises(ValueError, match="Unknown SMACv2 scenario '3m'"):
        smacv2.scenario("3m")
    env = make("3m")
    with pytest.raises(ValueError, match=r"call reset\(\)"):
        env.step({})
    env.reset(seed=0)
    with pytest.raises(ValueError, match="No action for 'agent_1'"):
        env.step({"agent_0": 1})
    with pytest.raises(ValueError, match="'agent_0' is 9; allowed are the integers from 0 to 8"):
        env.step({**still(env), "agent_0": 9})
    with pytest.raises(ValueError, match=r"'agent_2' cannot do action 0 now, possible are \[1, .*MaskableBeliefPPO"):
        env.step({**still(env), "agent_2": 0})
    with pytest.raises(ValueError, match="without a render mode"):
        env.render()
    picture = make("3m", render_mode="rgb_array")
    picture.reset()
    assert picture.render().shape == (4, 4, 3)


def test_results_can_name_the_version_of_starcraft(faults):
    env = make("3m")
    assert env.versions() == {"map": "smac/3m", "starcraft2": "unknown"}
    env.reset()
    assert env.versions() == {"map": "smac/3m", "starcraft2": "4.10.0"}
    assert make_v2("zerg_5_vs_5").versions()["map"] == "smacv2/zerg_5_vs_5"


@pytest.mark.parametrize("env_id", ["smac/2s3z", "smacv2/protoss_5_vs_5"])
def test_a_team_learns_is_saved_and_evaluated(faults, tmp_path, env_id):
    env = make_team_env(env_id, n_envs=2, seed=0)
    maker = partial(make, "2s3z") if env_id.startswith("smac/") else partial(make_v2, "protoss_5_vs_5")
    assert env.observation_space == make_team_env(maker).observation_space
    assert len(train_save_load_evaluate(maker, tmp_path, MaskableBeliefPPO)) == 2
    # Without masks the agents choose actions that the game refuses
    with pytest.raises(ValueError, match="heeds action masks"):
        Team(BeliefPPO, "BeliefPolicy", env, seed=0, n_steps=64).learn(128)


@pytest.mark.parametrize("maker", [MAKERS[1], MAKERS[3]])
def test_the_state_and_the_last_masks(faults, maker):
    env = make_team_env(maker, seed=0)
    assert env.state_source == "env"
    env.reset()
    rng, done, units = np.random.default_rng(0), False, 0
    while not done:
        (own,) = env.get_attr("game")
        state = env.states()[0]
        assert state in env.state_space and np.array_equal(state, own.get_state())
        actions = {agent: (rng.random(mask.shape) * mask).argmax(axis=1) for agent, mask in env.action_masks().items()}
        _, _, (done,), (info,) = env.step(actions)
        units = max(units, int((state > 0).sum()))
    # One side is dead, and whoever lost units is known by its masks
    assert 0 < (info["terminal_state"] > 0).sum() < units
    dead = [mask[0] for mask in info["terminal_action_masks"].values()]
    assert dead == (info["terminal_state"][: len(dead)] == 0).tolist()
