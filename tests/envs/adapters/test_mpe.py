"""``mpe/<name>``: a radius of sight hides teammates from the observations, and their actions from the agents' infos."""

from importlib import import_module
from typing import Any

import numpy as np
import pytest
import supersuit

from sb3_belief.envs import check_team_env, make_parallel_env
from sb3_belief.envs.adapters.mpe import LAYOUTS, AmongNearest, WithinRadius, names
from sb3_belief.team import make_team_env

ALL = names()
RADIUS = 0.7


def random_actions(env, rng):
    """Return random actions of the agents in play."""
    return {agent: int(rng.integers(env.action_space(agent).n)) for agent in env.agents}


def seen_alone(env, viewer):
    """
    Compute what a viewer observes if every agent beyond the radius stands at the viewer's place, at rest and silent.

    The relative positions, velocities and messages of those agents then are zero, so this needs no knowledge of where an
    observation shows which agent.

    :return: The observation, and for each other agent whether it is within the radius
    """
    world = env.unwrapped.world
    me = world.agents[viewer]
    hidden = [
        other for other in world.agents if other is not me and np.linalg.norm(other.state.p_pos - me.state.p_pos) > RADIUS
    ]
    kept = [(other.state.p_pos, other.state.p_vel, other.state.c) for other in hidden]
    for other in hidden:
        other.state.p_pos, other.state.p_vel = me.state.p_pos, np.zeros_like(me.state.p_vel)
        other.state.c = np.zeros(world.dim_c)
    observation = env.unwrapped.scenario.observation(me, world).astype(np.float32)
    for other, (p_pos, p_vel, c) in zip(hidden, kept, strict=True):
        other.state.p_pos, other.state.p_vel, other.state.c = p_pos, p_vel, c
    return observation, [other not in hidden for other in world.agents if other is not me]


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_radius_blanks_exactly_who_is_beyond_it(name):
    env: Any = make_parallel_env(f"mpe/{name}", radius=RADIUS)
    assert isinstance(env, WithinRadius)
    rng = np.random.default_rng(0)
    flags = []
    for seed in range(6):
        obs, _ = env.reset(seed=seed)
        while True:
            visible = env.visibility()
            for i, agent in enumerate(env.possible_agents):
                expected, who = seen_alone(env.env, i)
                np.testing.assert_array_equal(obs[agent], expected)
                assert obs[agent].dtype == np.float32 and visible[agent].tolist() == who
                flags += who
            if not env.agents:
                break
            # The last one is the terminal observation, with the world as it was at the end of the episode
            obs, *_ = env.step(random_actions(env, rng))
    assert any(flags) and not all(flags)


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_radius_as_wide_as_the_world_changes_nothing(name):
    plain, wide = make_parallel_env(f"mpe/{name}"), make_parallel_env(f"mpe/{name}", radius=1e6)
    rng = np.random.default_rng(1)
    a, b = plain.reset(seed=3), wide.reset(seed=3)
    while plain.agents:
        for agent in a[0]:
            np.testing.assert_array_equal(a[0][agent], b[0][agent])
        actions = random_actions(plain, rng)
        a, b = plain.step(actions), wide.step(actions)
        assert a[1:4] == b[1:4]
    assert all(row.all() for row in wide.visibility().values())


@pytest.mark.parametrize("name", ALL)
def test_everything_is_as_mpe2_has_it(name):
    ours: Any = make_parallel_env(f"mpe/{name}")
    theirs = import_module(f"mpe2.{name}").parallel_env()
    assert ours.possible_agents == theirs.possible_agents
    assert (ours.metadata, ours.state_space) == (theirs.metadata, theirs.state_space)
    rng = np.random.default_rng(2)
    for seed in (5, None):
        results: list[Any] = [env.reset(seed=seed) for env in (ours, theirs)]
        while theirs.agents:
            np.testing.assert_equal(*results)
            actions = random_actions(theirs, rng)
            results = [env.step(actions) for env in (ours, theirs)]
            assert ours.agents == theirs.agents
        np.testing.assert_equal(*results)


def test_wrong_actions_are_refused_by_the_team():
    env = make_team_env("mpe/simple_spread_v3", n_envs=2)
    env.reset()
    actions = {agent: np.zeros(2, dtype=int) for agent in env.possible_agents}
    actions["agent_1"][1] = 5
    with pytest.raises(ValueError, match=r"agent_1.*Discrete\(5\)"):
        env.step(actions)


@pytest.mark.parametrize("name", sorted(set(ALL) - set(LAYOUTS)))
def test_a_radius_is_refused_where_it_cannot_be_kept(name):
    with pytest.raises(ValueError, match=rf"'mpe/{name}' cannot have a radius: .*wrapper of your own"):
        make_parallel_env(f"mpe/{name}", radius=1.0)


@pytest.mark.parametrize(
    ("name", "kwargs", "message"),
    [
        ("simple_spred_v3", {}, "no 'simple_spred_v3'. Did you mean 'simple_spread_v3'"),
        ("simple_spread_v3", {"radius": 0}, "radius=0 must be greater than 0"),
        ("simple_spread_v3", {"radius": float("nan")}, "radius=nan must be greater than 0"),
        ("simple_spread_v3", {"radius": 1.0, "num_agent_neighbors": 1}, "two limits of sight"),
    ],
)
def test_what_is_refused(name, kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_parallel_env(f"mpe/{name}", **kwargs)


@pytest.mark.parametrize("name", ["simple_spread_v3", "simple_tag_v3", "simple_adversary_v3"])
def test_who_is_among_the_nearest_is_visible(name):
    env: Any = make_parallel_env(f"mpe/{name}", num_agent_neighbors=1)
    assert isinstance(env, AmongNearest)
    rng = np.random.default_rng(0)
    env.reset(seed=0)
    while env.agents:
        env.step(random_actions(env, rng))
        agents = env.unwrapped.world.agents
        for i, agent in enumerate(agents):
            others = [other for j, other in enumerate(agents) if j != i]
            apart = [np.linalg.norm(other.state.p_pos - agent.state.p_pos) for other in others]
            nearest = others[int(np.argmin(apart))]
            assert env.visibility()[agent.name].tolist() == [other is nearest for other in others]


def test_without_a_limit_everybody_in_play_is_visible():
    env = make_team_env("mpe/simple_spread_v3", n_envs=2, seed=0)
    env.reset()
    _, _, _, infos = env.step({agent: np.zeros(2, int) for agent in env.possible_agents})
    assert infos[0]["visible"].all() and infos[1]["visible"].shape == (3, 2)


@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_a_team_is_told_of_those_within_the_radius_only(vec_env):
    kwargs = {"radius": RADIUS, "max_cycles": 9}
    env = make_team_env("mpe/simple_spread_v3", n_envs=2, seed=5, vec_env=vec_env, env_kwargs=kwargs)
    alone: Any = make_parallel_env("mpe/simple_spread_v3", **kwargs)
    env.reset()
    alone.reset(seed=6)
    rng = np.random.default_rng(0)
    for t in range(1, 10):
        actions = {agent: rng.integers(5, size=2) for agent in env.possible_agents}
        _, _, dones, infos = env.step(actions)
        obs, *_ = alone.step({agent: int(actions[agent][1]) for agent in alone.agents})
        assert infos[1]["visible"].tolist() == [row.tolist() for row in alone.visibility().values()]
        assert dones.tolist() == [t == 9] * 2
    # The limit truncates, and the terminal observation hides teammates too
    assert infos[1]["TimeLimit.truncated"] is True and infos[1]["truncated"].all()
    for agent, value in infos[1]["terminal_observation"].items():
        np.testing.assert_array_equal(value, obs[agent])
    env.close()


def test_visibility_survives_wrappers():
    def wrap(env):
        # dtype_v0 converts the environment to AEC and back
        return supersuit.dtype_v0(supersuit.frame_stack_v1(env, 2), np.float64)

    kwargs = {"radius": 1.2}
    wrapped = make_team_env("mpe/simple_spread_v3", seed=1, env_kwargs=kwargs, wrapper=wrap)
    plain = make_team_env("mpe/simple_spread_v3", seed=1, env_kwargs=kwargs)
    seen = []
    for env in (wrapped, plain):
        env.reset()
        rng = np.random.default_rng(0)
        steps = [env.step({agent: rng.integers(5, size=1) for agent in env.possible_agents}) for _ in range(30)]
        seen.append(np.array([step[3][0]["visible"] for step in steps]))
    assert seen[0].any() and not seen[0].all()
    np.testing.assert_array_equal(seen[0], seen[1])


@pytest.mark.parametrize("name", ALL)
def test_all_of_them_keep_the_contract(name):
    report = check_team_env(f"mpe/{name}", n_steps=60)
    assert report.failures == []
    assert "0 terminated and 2 truncated" in str(report)
