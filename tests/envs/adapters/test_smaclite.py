"""The adapter to SMAClite, tested against a fake with its interface and faults, and where possible against the package."""

import sys
from functools import partial
from types import ModuleType
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from pettingzoo.test import parallel_api_test

from sb3_belief import MaskableBeliefPPO, make_team_env
from sb3_belief.envs.adapters import smaclite
from tests.envs.adapters.fake_smaclite import SIGHT, USED, FakeSMAClite
from tests.envs.adapters.tuple_helpers import make_team, train_save_load_evaluate


def fake(limit=60, **kwargs) -> Any:
    """Return a battle of the fake."""
    return smaclite.Battle(FakeSMAClite(render_mode=None, **kwargs), limit)


def real(name="2s3z", **kwargs) -> Any:
    """Return a battle of the package. Where that is not installed, skip the test."""
    pytest.importorskip("smaclite", reason="SMAClite is not installed, see docs/environments/smaclite.md")
    return smaclite.make(name, **kwargs)


def play(env, rng, seed=None):
    """Play an episode of random legal actions, and yield what ``step`` returned and which units were alive before it."""
    _, infos = env.reset(seed=seed)
    while env.agents:
        alive = set(env.game.agents)
        actions = {agent: int(rng.choice(np.flatnonzero(info["action_mask"]))) for agent, info in infos.items()}
        step = env.step(actions)
        infos = step[4]
        yield *step, alive


def in_sight(env):
    """Compute from the positions which unit sees which other: both are alive and within the sight range."""
    units, n = env.game.agents, env.game.n_agents
    near = [
        [i in units and j in units and np.linalg.norm(units[i].pos - units[j].pos) <= SIGHT for j in range(n)]
        for i in range(n)
    ]
    return [row[:i] + row[i + 1 :] for i, row in enumerate(near)]


@pytest.mark.parametrize("make", [fake, real])
def test_the_state(make):
    env: Any = make_team_env(make, seed=0)
    assert env.state_source == "env"
    env.reset()
    (game,) = env.get_attr("game")
    assert np.array_equal(env.states()[0], np.float32(game.get_state())) and env.states()[0].any()


@pytest.mark.parametrize("make", [fake, real, partial(real, "3s5z")])
def test_who_is_seen(make):
    env, rng = make(), np.random.default_rng(0)
    seen = unseen = 0
    for seed in range(30 if make is fake else 2):
        for *_, _alive in play(env, rng, seed):
            rows = [row.tolist() for row in env.visibility().values()]
            assert rows == in_sight(env)
            # The last step is included. Dead units neither see nor are seen
            seen, unseen = seen + sum(map(sum, rows)), unseen + sum(map(len, rows)) - sum(map(sum, rows))
    assert seen > 100 and unseen > 100


def test_no_impossible_action_is_sent_in_10000_steps():
    env, rng = fake(), np.random.default_rng(0)
    steps = dead = ends = 0
    while steps < 10_000:
        for obs, rewards, terminations, truncations, infos, alive in play(env, rng):
            steps += 1
            for i, agent in enumerate(env.possible_agents):
                # Whether the unit was alive when it acted
                assert infos[agent].get("active", True) == (i in alive)
                assert infos[agent].get("next_active", True) == (i in env.game.agents)
                mask = infos[agent]["action_mask"]
                assert mask.dtype == bool and mask.shape == (env.action_space(agent).n,) and mask.any()
                if i not in env.game.agents:
                    dead += 1
                    assert np.flatnonzero(mask).tolist() == [0] and not obs[agent].any()
            assert len(set(rewards.values())) == 1  # Dead units are given it too
            over = not env.game.enemies or not env.game.agents
            assert set(terminations.values()) == {over} and not (over and any(truncations.values()))
            if not env.agents:
                ends += 1
                assert {info["is_success"] for info in infos.values()} == {not env.game.enemies}
    assert dead > 1000 and ends > 100


def test_the_limit_is_ours_and_truncates():
    env = fake(limit=7, deadly=0.0)
    steps = list(play(env, np.random.default_rng(0), 0))
    assert len(steps) == 7 and all(steps[-1][3].values()) and not any(steps[-1][2].values())
    assert not any(info["is_success"] for info in steps[-1][4].values())


@pytest.mark.parametrize("deadly", [0.0, 1.0])
def test_a_battle_that_is_over_terminates_even_at_the_limit(deadly):
    env = fake(limit=1, deadly=deadly)
    env.reset(seed=0)
    if not deadly:
        env.game.enemies.clear()
    _, _, terminations, truncations, infos = env.step(dict.fromkeys(env.possible_agents, 1))
    assert all(terminations.values()) and not any(truncations.values())
    assert {info["is_success"] for info in infos.values()} == {not deadly}


def test_actions():
    env = fake()
    env.reset(seed=0)
    while len(env.game.agents) == 4:
        env.step(dict.fromkeys(env.possible_agents, np.int64(1)))
    (dead,) = set(range(4)) - set(env.game.agents)
    # Whatever a dead unit chooses, the game is sent 0
    _, _, _, _, infos = env.step(dict.fromkeys(env.possible_agents, 1))
    assert [info["active"] for info in infos.values()] == [i != dead for i in range(4)]
    with pytest.raises(ValueError, match=r"cannot do action 0 now, possible are \[1, 2.*MaskableBeliefPPO"):
        env.step(dict.fromkeys(env.possible_agents, 0))
    with pytest.raises(ValueError, match="'agent_0' is 9, which is not in its space"):
        env.step(dict.fromkeys(env.possible_agents, 9))


def test_pettingzoo_s_own_test():
    class AnyAction(smaclite.Battle):
        """Battle that replaces all actions by a legal one, since PettingZoo's test ignores masks."""

        def _joint_action(self, actions):
            return super()._joint_action({agent: 1 for agent in actions})

    parallel_api_test(AnyAction(FakeSMAClite(), 20), num_cycles=100)


def test_masks_in_rollout_and_update():
    team = make_team(fake, 32, MaskableBeliefPPO, batch_size=16)
    given: dict[str, list] = {agent: [] for agent in team.agents}

    def watch(locals_, globals_):
        for agent, masks in team.get_env().action_masks().items():
            given[agent].append(masks.copy())
        return True

    first = team.get_env().action_masks() or {}
    assert not first  # There are none before the first reset
    team.learn(64, callback=watch)
    for agent, model in team.agents.items():
        buffer = model.rollout_buffer
        # After the update each copy's steps stand one after the other. Masks belong to the observation that was acted on
        stored = buffer.action_masks.reshape(2, 32, -1).astype(bool)
        np.testing.assert_array_equal(stored[:, 1:], np.array(given[agent])[:-1].swapaxes(0, 1))
        acted = buffer.actions.reshape(-1).astype(int)
        assert stored.reshape(64, -1)[np.arange(64), acted].all()


@pytest.fixture
def installed(monkeypatch):
    """Install an empty module of that name, and register the fake under the ids of three maps."""
    monkeypatch.setitem(sys.modules, "smaclite", ModuleType("smaclite"))
    for name in ("2s3z", "custom", "secret"):
        id = f"smaclite/{name}-v0"
        entry: Any = FakeSMAClite
        monkeypatch.setitem(gym.registry, id, gym.envs.registration.EnvSpec(id, entry_point=entry))


def test_arguments(installed):
    assert set(smaclite.names()) >= {"2s3z", "secret"} and "custom" not in smaclite.names()
    env = smaclite.make("2s3z", use_cpp_rvo2=True)
    assert env.max_episode_steps == 120 and env.render_mode is None and env.game.use_cpp_rvo2 is True
    assert smaclite.make("2s3z", max_episode_steps=9, render_mode="rgb_array").max_episode_steps == 9
    with pytest.raises(ValueError, match=r"'secret' has no known episode limit: give max_episode_steps"):
        smaclite.make("secret")
    assert smaclite.make("custom", max_episode_steps=5).metadata["name"] == "custom"
    with pytest.raises(ValueError, match=r"no environment 'smaclite/2s3y-v0'.*Did you mean 'smaclite/2s3z-v0'"):
        smaclite.make("2s3y")


def test_training(tmp_path):
    train_save_load_evaluate(partial(fake, 20), tmp_path, MaskableBeliefPPO)


# Tests that need the package itself


def test_the_fake_has_the_interface_of_the_package():
    package: Any = real().game
    imitation: Any = FakeSMAClite()
    package.reset(seed=0)
    imitation.reset(seed=0)
    for name in USED:
        assert type(getattr(package, name)) is type(getattr(imitation, name)), name
    for env in (package, imitation):
        assert all(isinstance(space, gym.spaces.Discrete) for space in env.action_space)
        assert {space.dtype for space in env.observation_space} == {np.dtype(np.float32)}
        for wrong in ([np.int64(1)] * env.n_agents, [1] * (env.n_agents - 1)):
            with pytest.raises(AssertionError):
                env.step(wrong)
        with pytest.raises(ValueError, match="Invalid action for agent 0: 0"):
            env.step([0] * env.n_agents)
        obs, reward, terminated, truncated, info = env.step([1] * env.n_agents)
        assert (len(obs), type(reward), type(terminated), truncated) == (env.n_agents, float, bool, False)
        assert info == {"battle_won": False}
        assert [len(row) for row in env.get_avail_actions()] == [env.n_actions] * env.n_agents


def test_the_package_s_seeds():
    used, rng = real(), np.random.default_rng(0)
    list(play(used, rng, 3))
    runs = [[step[0]["agent_0"] for step in play(env, np.random.default_rng(1), 5)] for env in (used, real())]
    assert len(runs[0]) == len(runs[1]) and all(np.array_equal(a, b) for a, b in zip(*runs, strict=True))


def test_all_maps_of_the_package_have_a_limit():
    real()
    assert {name: smaclite.make(name).max_episode_steps for name in smaclite.names()} == smaclite.EPISODE_LIMITS


@pytest.mark.parametrize("name", ["3s_vs_5z", "MMM"])
def test_training_with_the_package(name, tmp_path):
    train_save_load_evaluate(lambda: real(name, max_episode_steps=20), tmp_path, MaskableBeliefPPO)
