"""Replays: whose environment is known from the command line only, without a display, of small pictures, and what is said."""

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from sb3_belief import BeliefPPO, Team, make_team_env
from sb3_belief.cli.main import main
from sb3_belief.envs import make_parallel_env
from sb3_belief.envs.switching_convention.vec_env import SwitchingConventionVecEnv
from tests.field.command_lines import ENV
from tests.team.toy_envs import ToyEnv

imageio = pytest.importorskip("imageio.v2")
pytest.importorskip("pygame")

MODULE = """
from tests.field.test_pictures import PixelEnv

def make(mode="good", render_mode=None, limit=3):
    return PixelEnv(mode, render_mode, limit)
"""


class PixelEnv(ToyEnv):
    """Has a picture of a pixel a cell, 4 rows by 6 columns, or something else that is none."""

    metadata = {"name": "pixels", "render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(self, mode="good", render_mode=None, limit=3):
        super().__init__(2, limit, render_mode)
        self.mode = mode

    def render(self):
        if self.mode != "good":
            return None if self.mode == "none" else np.zeros((4, 6))
        picture = np.zeros((4, 6, 3), np.uint8)
        picture[:, 3:] = 255
        return picture


def saved(env, path):
    """A team as a user saves it from Python."""
    Team(BeliefPPO, "BeliefPolicy", env, seed=0, n_steps=4, batch_size=4, policy_kwargs={"net_arch": [4]}).save(path)
    return str(path)


@pytest.fixture
def pixels(tmp_path, monkeypatch):
    """The words that replay a team of the small pictures."""
    (tmp_path / "pixel_games.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    team = saved(make_team_env(PixelEnv), tmp_path / "pixels.zip")
    return ["enjoy", team, "--env", "pixel_games:make", "--allow-package", "pixel_games", "tests"]


def test_a_team_from_python_is_replayed_with_env(pixels, tmp_path, capsys):
    assert main([*pixels, "--env-kwargs", "limit:5", "--output", "a.gif"]) == 0
    said = capsys.readouterr().out
    assert "Episode 1: return" in said and "5 steps" in said
    # One episode has no spread
    assert "std" not in said
    assert main([*pixels, "--episodes", "2", "--output", "a.gif"]) == 0
    assert "Mean return over 2 episodes" in (said := capsys.readouterr().out) and "(std " in said
    assert main([*pixels[:2]]) == 2
    assert "name it with --env, and its arguments with --env-kwargs" in capsys.readouterr().err
    assert main([*pixels, "--env-kwargs", "limmit:5"]) == 2
    assert "--env-kwargs: unknown key 'limmit'. Did you mean 'limit'" in capsys.readouterr().err
    assert main(["enjoy", pixels[1], "--env", "convention-swap"]) == 2
    assert "The saved team has the agents ['agent_0', 'agent_1']" in capsys.readouterr().err


def test_small_pictures_are_enlarged_by_whole_numbers(pixels):
    assert main([*pixels, "--output", "a.gif"]) == 0
    frame = imageio.mimread("a.gif")[0][..., :3]
    assert frame.shape == (4 * 80, 6 * 80, 3)
    assert frame[:, : 3 * 80].max() < 10 and frame[:, 3 * 80 :].min() > 245


@pytest.mark.parametrize(("mode", "message"), [("none", "returned NoneType"), ("flat", "returned an array of shape (4, 6)")])
def test_what_is_no_picture_is_refused(mode, message, pixels, capsys):
    assert main([*pixels, "--env-kwargs", f"mode:{mode}", "--output", "a.gif"]) == 2
    assert f"enjoy: the environment's render() {message}, not an image" in capsys.readouterr().err


def test_an_environment_without_a_window_says_so(pixels, capsys):
    assert main(pixels) == 0
    said = capsys.readouterr().out
    assert "Nothing is shown: pixel_games:make has no render mode 'human'. Write a file instead: --output episode.gif" in said


def test_a_window_on_no_display_says_so(tmp_path, monkeypatch, capsys):
    import pygame

    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame.display.quit()
    team = saved(make_team_env("traffic-junction-easy"), tmp_path / "team.zip")
    assert main(["enjoy", team, "--env", "traffic-junction-easy", "-n", "2"]) == 0
    said = capsys.readouterr().out
    assert said.count("Nothing is shown: there is no display. Write a file instead: --output episode.gif") == 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--output", "/proc/a.gif"], "--output: cannot write the file '/proc/a.gif'"),
        (["--output", "taken/a.gif"], "--output: cannot write the file 'taken/a.gif' (a file of this name exists)"),
        (["--output", "folder.gif"], "--output: cannot write the file 'folder.gif' (Is a directory)"),
        (["--device", "gpu"], "--device: 'gpu' is not available here"),
        (["--fps", "0"], "--fps: must be a whole number from 1 to 1,000"),
    ],
)
def test_what_is_refused_before_the_replay(words, message, pixels, tmp_path, capsys):
    (tmp_path / "taken").touch()
    (tmp_path / "folder.gif").mkdir()
    try:
        assert main([*pixels, *words]) == 2
    except SystemExit as stop:
        assert stop.code == 2
    assert message in capsys.readouterr().err
    assert (tmp_path / "taken").read_text() == ""


@pytest.mark.parametrize("env_id", [ENV, "lbf/Foraging-2s-5x5-2p-1f-coop-v3", "rware/rware-tiny-2ag-v2"])
def test_games_are_drawn_without_a_display(env_id, tmp_path, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    team = saved(make_team_env(env_id), tmp_path / "team.zip")
    assert main(["enjoy", team, "--env", env_id, "-n", "4", "--output", str(tmp_path / "a.gif")]) == 0
    frames = imageio.mimread(tmp_path / "a.gif", memtest=False)
    assert len(frames) == 4 and frames[0].std() > 10


def test_a_convention_shows_cues_and_actions():
    env: Any = make_parallel_env(ENV, render_mode="rgb_array", rollout_steps=8)
    env.reset(seed=0)
    first = env.render()
    assert isinstance(first, np.ndarray) and first.shape == (480, 480, 3)
    # No action yet: the lower half is empty
    assert len(np.unique(first[250:350, 10:110].reshape(-1, 3), axis=0)) == 1
    leader = int(env.convention[int(env.game.cue[0])])
    env.step({"follower": leader})
    right = env.render()
    env.reset(seed=0)
    env.step({"follower": (leader + 1) % 4})
    wrong = env.render()
    centre = 60 + 120 * leader
    leads, follows = (300, centre - 30), (420, centre - 30)
    assert (right[leads] == wrong[leads]).all() and (right[leads] != first[leads]).any()
    assert (right[follows] != wrong[follows]).any()
    batch = SwitchingConventionVecEnv(2, render_mode="rgb_array", K=2, rewarded="always")
    batch.reset()
    assert [image.shape for image in batch.get_images() if image is not None] == [(480, 480, 3)] * 2
    with pytest.raises(ValueError, match="render_mode='human' is not one of None, 'rgb_array'"):
        make_parallel_env(ENV, render_mode="human")
    with pytest.raises(ValueError, match="made without a render mode"):
        make_parallel_env(ENV).render()
    assert isinstance(env.action_space("follower"), spaces.Discrete)
