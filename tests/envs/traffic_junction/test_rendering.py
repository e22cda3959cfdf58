"""Pictures of the Traffic Junction, as arrays and in a window."""

import os
import sys
from typing import Any

import numpy as np
import pytest

from sb3_belief.envs import TrafficJunction
from sb3_belief.envs.traffic_junction.vec_env import TrafficJunctionVecEnv
from tests.envs.traffic_junction.scenarios import EAST, STRAIGHT, TOP, put


def test_missing_pygame_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    env = TrafficJunction(render_mode="rgb_array")
    env.reset(seed=0)
    with pytest.raises(ImportError, match=r'pip install "sb3-belief\[plots\]"'):
        env.render()


@pytest.fixture(autouse=True)
def needs_pygame(request):
    """Skip the tests that draw where pygame is not installed."""
    if "missing_pygame" not in request.node.name:
        pytest.importorskip("pygame")


@pytest.mark.parametrize("level", ["easy", "medium", "hard"])
def test_pictures_show_what_happens_and_nothing_else(level):
    env: Any = TrafficJunction(level, render_mode="rgb_array", arrival_rate=0.5)
    env.reset(seed=0)
    empty = env.render()
    assert empty.shape == (640, 608, 3) and empty.dtype == np.uint8 and empty.flags.c_contiguous
    np.testing.assert_array_equal(env.render(), empty)
    actions = dict.fromkeys(env.possible_agents, 0)
    for _ in range(3):
        env.step(actions)
    picture = env.render()
    changed = (picture != empty).any(axis=2)
    size = env.core.layout.level.size
    side = 608 / size
    occupied = {divmod(int(c), size) for c in env.core.layout.cell[env.core.place[env.core.on_road]]}
    assert occupied
    for row, column in occupied:
        y, x = round(32 + (row + 0.5) * side), round((column + 0.5) * side)
        assert changed[y - 5 : y + 6, x - 5 : x + 6].mean() > 0.5
    # The grass in the corner does not change
    assert not changed[32 : 32 + int(side), : int(side)].any()
    again = TrafficJunction(level, render_mode="rgb_array", arrival_rate=0.5)
    again.reset(seed=0)
    for _ in range(3):
        again.step(actions)
    np.testing.assert_array_equal(again.render(), picture)
    env.close()


def test_collisions_are_marked_and_counted():
    pictures = []
    for crash in (True, False):
        env: Any = TrafficJunction(render_mode="rgb_array", arrival_rate=0.0)
        env.reset(seed=0)
        put(env.core, 0, TOP, STRAIGHT, 5)
        put(env.core, 1, EAST, STRAIGHT, 6)
        env.step({**dict.fromkeys(env.possible_agents, 0), "car_1": 0 if crash else 1})
        pictures.append(env.render().astype(int))

    def red(picture):
        """Return the number of pixels in the colour of the collision mark, in (6, 6) and one and a half cells around it."""
        part = picture[32 + 195 : 32 + 369, 195:369]
        return (np.abs(part - (240, 62, 44)).max(axis=2) < 25).sum()

    assert red(pictures[0]) > 300 > 20 > red(pictures[1])
    assert (pictures[0][:32] != pictures[1][:32]).any(), "the bar counts it"


def test_vec_env_pictures_are_those_of_its_copies():
    env: Any = TrafficJunctionVecEnv(3, render_mode="rgb_array", arrival_rate=0.5)
    env.seed(2)
    env.reset()
    single = TrafficJunction(render_mode="rgb_array", arrival_rate=0.5)
    single.reset(seed=3)
    for _ in range(4):
        env.step({agent: np.zeros(3, dtype=int) for agent in env.possible_agents})
        single.step(dict.fromkeys(single.possible_agents, 0))
    images = env.get_images()
    assert len(images) == 3
    np.testing.assert_array_equal(images[1], single.render())
    tiled = env.render()
    assert tiled.shape == (2 * 640, 2 * 608, 3)
    np.testing.assert_array_equal(tiled[:640, 608:], images[1])
    env.close()


def test_pictures_need_no_display_and_leave_the_users_driver_alone(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setenv("SDL_VIDEODRIVER", "x11")
    env: Any = TrafficJunction("easy", render_mode="rgb_array")
    env.reset(seed=0)
    assert env.render().any()
    assert os.environ["SDL_VIDEODRIVER"] == "x11"
    env.close()


@pytest.mark.parametrize("batched", [False, True])
def test_window(monkeypatch, batched):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    import pygame

    env: Any
    actions: dict[str, Any]
    if batched:
        env = TrafficJunctionVecEnv(2, level="easy", render_mode="human", arrival_rate=1.0)
        actions = {agent: np.zeros(2, dtype=int) for agent in env.possible_agents}
    else:
        env = TrafficJunction("easy", render_mode="human", arrival_rate=1.0)
        actions = dict.fromkeys(env.possible_agents, 0)
    env.reset()
    window: Any = pygame.display.get_surface()
    assert window.get_size() == (608, 640)
    before = pygame.surfarray.array3d(window)
    env.step(actions)
    assert (pygame.surfarray.array3d(window) != before).any()
    assert env.render() is None
    env.close()
    assert not pygame.display.get_init()
    env.close()
