"""Where agents are in the picture, by the pixels there."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sb3_belief import make_team_env
from sb3_belief.envs.pictures import AGENT_COLOURS
from sb3_belief.envs.traffic_junction.rendering import _CARS

pytest.importorskip("pygame")


def played(env_id, n_steps, **env_kwargs):
    env: Any = make_team_env(env_id, n_envs=1, seed=3, env_kwargs={"render_mode": "rgb_array", **env_kwargs})
    env.reset()
    rng = np.random.default_rng(0)
    for _ in range(n_steps):
        env.step({agent: np.array([rng.integers(space.n)]) for agent, space in env.action_space.items()})
    return env


def near(image, position, reach=12):
    """The pixels around a position."""
    x, y = position[0] * image.shape[1], position[1] * image.shape[0]
    rows, columns = (slice(max(int(at) - reach, 0), int(at) + reach) for at in (y, x))
    return image[rows, columns].reshape(-1, 3)


@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_cars_are_where_they_are_drawn(vec_env):
    env = make_team_env(
        "traffic-junction-easy",
        n_envs=1,
        seed=3,
        vec_env=vec_env,
        env_kwargs={"render_mode": "rgb_array", "arrival_rate": 0.9},
    )
    try:
        env.reset()
        assert env.env_method("picture_positions")[0] == {}
        seen = set()
        for _ in range(5):
            env.step({agent: np.array([0]) for agent in env.possible_agents})
            image, positions = env.get_images()[0], env.env_method("picture_positions")[0]
            for car, position in positions.items():
                # Cars in one cell are drawn a little apart
                if list(positions.values()).count(position) > 1:
                    continue
                colour = np.array(_CARS[env.possible_agents.index(car)])
                assert (np.abs(near(image, position).astype(int) - colour).max(axis=1) < 40).mean() > 0.1, car
                seen.add(car)
        assert len(seen) > 2 and env.get_attr("action_names")[0] == ("gas", "brake")
    finally:
        env.close()


@pytest.mark.parametrize(
    ("package", "env_id"), [("lbforaging", "lbf/Foraging-8x8-3p-2f-v3"), ("rware", "rware/rware-tiny-4ag-v2")]
)
def test_players_and_robots_are_where_they_are_drawn(package, env_id):
    pytest.importorskip(package)
    env = played(env_id, 5)
    image, positions = env.get_images()[0], env.env_method("picture_positions")[0]
    assert list(positions) == env.possible_agents
    for i, position in enumerate(positions.values()):
        assert (near(image, position) == AGENT_COLOURS[i]).all(axis=1).mean() > 0.3
    names = env.get_attr("action_names")[0]
    assert len(names) == env.action_space[env.possible_agents[0]].n
    env.close()


@pytest.mark.parametrize("n_steps", [0, 7])
def test_particles_are_where_they_are_drawn(n_steps):
    pytest.importorskip("mpe2")
    env = played("mpe/simple_tag_v3", n_steps)
    image, positions = env.get_images()[0], env.env_method("picture_positions")[0]
    assert list(positions) == env.possible_agents
    for position in positions.values():
        # Discs on white, that may lie beyond the edge of the picture
        if 0.02 < min(position) and max(position) < 0.98:
            assert (near(image, position, reach=4) < 250).any(axis=1).all()
    assert env.get_attr("action_names")[0]["agent_0"] == ["nothing", "left", "right", "down", "up"]
    speaking = make_team_env("mpe/simple_speaker_listener_v4", n_envs=1)
    assert list(speaking.get_attr("action_names")[0]) == ["listener_0"]


@pytest.mark.parametrize("map_size", [(32.0, 32.0), (32.0, 16.0), (10.0, 20.0)])
def test_units_are_where_they_are_drawn(map_size):
    pytest.importorskip("matplotlib")
    from sb3_belief.envs.adapters.smax.rendering import draw, unit_positions

    places = np.array([[0.3, 0.6], [0.8, 0.2], [0.5, 0.5]]) * map_size
    units = {"positions": places, "types": np.zeros(3, int), "health": np.ones(3), "alive": np.array([True, False, True])}
    drawing = SimpleNamespace(map_size=map_size, radii=[1.5], full_health=[1.0], letters=[""])
    battles: Any = SimpleNamespace(agents=["ally_0", "ally_1"], drawing=drawing, units=lambda copy: units)
    image, positions = draw(battles, 0), unit_positions(battles, 0)
    assert list(positions) == ["ally_0"]
    blue = (near(image, positions["ally_0"], reach=6)[:, 2] > 150) & (near(image, positions["ally_0"], reach=6)[:, 0] < 80)
    assert blue.mean() > 0.9
