"""When checkpoints are written, which stay, and what is kept in memory between them."""

import errno
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import sb3_belief.team.checkpoints as checkpoints_module
from sb3_belief.team.checkpoints import RESET_FREQ, Checkpoints, checkpoint_files
from tests.common.crashes import check_old_or_new, recorded


class FakeTeam:
    """
    A team of which only the number of steps is saved.

    :param needs_reset: Whether checkpoints reset its environment
    """

    def __init__(self, needs_reset=False):
        self.num_timesteps = 0
        self.exact_needs_reset = needs_reset
        self.error: Exception | None = None
        self.saves: list[tuple[int, bool]] = []
        self.synced: list[str] = []
        self._loop = SimpleNamespace(begins_rollouts=True)
        self._log = SimpleNamespace(sync=lambda: self.synced.append("log"))
        self.env = SimpleNamespace(unwrapped=SimpleNamespace(sync_monitor=lambda: self.synced.append("monitor")))

    def get_env(self):
        return self.env

    def save(self, file, exact=False):
        if exact and self.error is not None:
            raise self.error
        self.saves.append((self.num_timesteps, exact))
        content = f"{self.num_timesteps}{' exact' if exact else ''}".encode()
        if isinstance(file, Path):
            file.write_bytes(content)
        else:
            file.write(content)


class Clock:
    """A clock that stands still unless it is moved."""

    def __init__(self, monkeypatch):
        self.now = 1000.0
        monkeypatch.setattr(checkpoints_module.time, "monotonic", lambda: self.now)


@pytest.fixture
def clock(monkeypatch):
    return Clock(monkeypatch)


def start(folder, team=None, **kwargs):
    team = team or FakeTeam()
    callback: Any = Checkpoints(folder, **kwargs)
    callback.init_callback(team)
    callback.on_training_start({}, {})
    return team, callback


def rollouts(team, callback, *steps):
    """Begin rollouts at numbers of steps."""
    for k in steps:
        team.num_timesteps = k
        callback.on_rollout_start()


def names(folder):
    return [path.name for _, path in checkpoint_files(folder)]


def test_files_by_steps(tmp_path, clock):
    """The first, and then at the first beginning of a rollout after each 100 steps."""
    team, callback = start(tmp_path, save_freq=100, keep=9)
    rollouts(team, callback, 0, 80, 160, 180, 199, 200, 240, 430, 500)
    assert names(tmp_path) == [f"team_{k}_steps.zip" for k in (0, 160, 200, 430, 500)]
    assert (tmp_path / "team_430_steps.zip").read_bytes() == b"430 exact"


def test_files_by_time(tmp_path, clock):
    team, callback = start(tmp_path, save_every=60.0, keep=9)
    for i in range(8):
        rollouts(team, callback, 10 * i)
        clock.now += 25
    assert names(tmp_path) == [f"team_{k}_steps.zip" for k in (0, 30, 60)]


def test_files_by_both(tmp_path, clock):
    team, callback = start(tmp_path, save_freq=1000, save_every=60.0, keep=9)
    rollouts(team, callback, 0)
    clock.now += 59
    rollouts(team, callback, 900, 1000)
    clock.now += 59
    rollouts(team, callback, 1100)
    clock.now += 1
    rollouts(team, callback, 1200)
    assert names(tmp_path) == [f"team_{k}_steps.zip" for k in (0, 1000, 1200)]


def test_without_both_there_is_the_state_in_memory_only(tmp_path, clock):
    team, callback = start(tmp_path / "never")
    rollouts(team, callback, 0, 80)
    assert (callback.last.steps, callback.last.content) == (80, b"80 exact")
    assert not (tmp_path / "never").exists()
    assert callback.save_last() == tmp_path / "never" / "team_80_steps.zip"
    assert callback.save_last().read_bytes() == b"80 exact"


def test_the_last_ones_stay_by_number_and_not_by_name(tmp_path, clock):
    (tmp_path / "other_1_steps.zip").touch()
    (tmp_path / "best_model.zip").touch()
    team, callback = start(tmp_path, save_freq=1)
    rollouts(team, callback, 80, 900, 1000, 20_000)
    assert names(tmp_path) == ["team_1000_steps.zip", "team_20000_steps.zip"]
    assert (tmp_path / "other_1_steps.zip").exists() and (tmp_path / "best_model.zip").exists()


def test_files_of_later_steps_do_not_push_out_those_that_are_written(tmp_path, clock):
    """A damaged newest one may be there when the training goes on from the one before."""
    (tmp_path / "team_500_steps.zip").touch()
    team, callback = start(tmp_path, save_freq=1)
    rollouts(team, callback, 100, 200, 300)
    assert names(tmp_path) == ["team_200_steps.zip", "team_300_steps.zip", "team_500_steps.zip"]


def test_name_prefix_and_verbose(tmp_path, clock, capsys):
    team, callback = start(tmp_path, save_freq=1, keep=1, name_prefix="a_1", verbose=1)
    rollouts(team, callback, 5, 10)
    assert [path.name for path in tmp_path.iterdir()] == ["a_1_10_steps.zip"]
    assert checkpoint_files(tmp_path, "a_1") == [(10, tmp_path / "a_1_10_steps.zip")]
    assert checkpoint_files(tmp_path, "a") == checkpoint_files(tmp_path) == []
    assert capsys.readouterr().out.splitlines()[1] == f"Checkpoint: {tmp_path / 'a_1_10_steps.zip'}"


@pytest.mark.parametrize("wrong", [{"save_freq": 0}, {"save_every": -1.0}, {"keep": 0}])
def test_wrong_numbers_are_refused(tmp_path, wrong):
    ((name, value),) = wrong.items()
    with pytest.raises(ValueError, match=f"{name} must be positive, or None, not {value}"):
        Checkpoints(tmp_path, **wrong)


def test_memory_takes_a_hundredth_of_the_time(tmp_path, clock):
    team, callback = start(tmp_path)
    real = team.save

    def slow(*args, **kwargs):
        clock.now += 0.5
        real(*args, **kwargs)

    team.save = slow
    for i in range(1000):
        rollouts(team, callback, i)
        clock.now += 1
    # Every 50 seconds, in which there is one save of half a second
    assert len(team.saves) == pytest.approx(20, abs=1)
    assert len(team.saves) * 0.5 <= 0.0101 * 1000


def test_logs_are_synced_before_a_file_counts_on_them(tmp_path, clock, monkeypatch):
    team, callback = start(tmp_path, save_freq=100)
    real = checkpoints_module.replaced_file
    monkeypatch.setattr(checkpoints_module, "replaced_file", lambda *args: (team.synced.append("file"), real(*args))[1])
    rollouts(team, callback, 0, 50, 100)
    assert team.synced == ["log", "monitor", "file"] * 2


def test_large_states_are_not_held_in_memory(tmp_path, clock, monkeypatch):
    monkeypatch.setattr(checkpoints_module, "_MOST_BYTES", 8)
    team, callback = start(tmp_path, save_freq=100)
    rollouts(team, callback, 0, 50)
    assert callback.last.content == b"50 exact"
    # "100 exact" is longer
    rollouts(team, callback, 100)
    assert callback.last.content is None and callback.last.path.read_bytes() == b"100 exact"
    clock.now += 1e6
    rollouts(team, callback, 150)
    assert callback.last.steps == 100
    rollouts(team, callback, 200)
    assert (callback.last.steps, callback.last.content) == (200, None)
    assert callback.save_last() == tmp_path / "team_200_steps.zip"
    assert names(tmp_path) == ["team_100_steps.zip", "team_200_steps.zip"]
    assert team.saves == [(k, True) for k in (0, 50, 100, 200)]


@pytest.mark.parametrize(("save_freq", "freq"), [(None, RESET_FREQ), (1000, 1000)])
def test_resets_at_checkpoints_do_not_depend_on_the_clock(tmp_path, clock, save_freq, freq):
    team, callback = start(tmp_path, FakeTeam(needs_reset=True), save_freq=save_freq, save_every=60.0, keep=9)
    for k in range(0, 2 * freq + 1, freq // 4):
        rollouts(team, callback, k)
        clock.now += 100
    assert names(tmp_path) == [f"team_{k}_steps.zip" for k in (0, freq, 2 * freq)]
    # In between, what is kept in memory is not exact, and resets nothing
    assert team.saves == [(k, k % freq == 0) for k in range(0, 2 * freq + 1, freq // 4)]
    rollouts(team, callback, 2 * freq + 1)
    assert callback.last.content == str(2 * freq + 1).encode()
    assert callback.save_last() == tmp_path / f"team_{2 * freq}_steps.zip"


def test_a_training_that_goes_on_has_its_state_already(tmp_path, clock):
    path = tmp_path / "team_300_steps.zip"
    path.write_bytes(b"300 exact")
    team = FakeTeam()
    team.num_timesteps = 300
    _, callback = start(tmp_path, team, save_freq=100, save_every=60.0, resumed_from=path)
    rollouts(team, callback, 300)
    assert team.saves == [] and callback.last.content == b"300 exact" and callback.save_last() == path
    rollouts(team, callback, 380)
    assert names(tmp_path) == ["team_300_steps.zip"]
    rollouts(team, callback, 400)
    assert names(tmp_path) == ["team_300_steps.zip", "team_400_steps.zip"]


def test_where_an_agent_is_in_the_middle_of_a_rollout_the_models_are_kept(tmp_path, clock, recwarn):
    team, callback = start(tmp_path, save_freq=100)
    rollouts(team, callback, 0)
    team._loop.begins_rollouts = False
    rollouts(team, callback, 100, 110)
    # Exactly it goes on from the beginning only
    assert callback.last.content == b"110" and callback.save_last() == tmp_path / "team_0_steps.zip"
    team._loop.begins_rollouts = True
    rollouts(team, callback, 120, 150)
    assert names(tmp_path) == ["team_0_steps.zip", "team_120_steps.zip"]
    team._loop.begins_rollouts = False
    rollouts(team, callback, 160)
    # The one at 150 has been kept for an interruption, beside newer models
    assert callback.last.content == b"160"
    assert callback.save_last().read_bytes() == b"150 exact"
    assert names(tmp_path) == ["team_120_steps.zip", "team_150_steps.zip"]
    assert not recwarn


def test_a_long_wait_is_said_once(tmp_path, clock):
    team, callback = start(tmp_path, save_freq=100)
    team._loop.begins_rollouts = False
    rollouts(team, callback, *range(0, 190, 10))
    with pytest.warns(UserWarning, match="has been due for 20 rollouts, but the agents' rollouts have unequal lengths"):
        rollouts(team, callback, 190)
    rollouts(team, callback, *range(200, 600, 10))
    assert names(tmp_path) == []


def test_a_second_training_counts_anew(tmp_path, clock):
    team, callback = start(tmp_path, save_freq=100)
    rollouts(team, callback, 0, 500)
    team.num_timesteps = 0
    callback.on_training_start({}, {})
    assert callback.last.steps == -1
    rollouts(team, callback, 0, 100)
    assert (tmp_path / "team_100_steps.zip").exists()


def test_a_full_disk_is_a_warning_and_the_next_one_is_tried(tmp_path, clock, monkeypatch):
    team, callback = start(tmp_path, save_freq=100)
    rollouts(team, callback, 0)
    with monkeypatch.context() as patched:

        def fail(*_):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        patched.setattr(os, "fsync", fail)
        for k in (100, 200):
            with pytest.warns(UserWarning, match=f"checkpoint at {k} joint steps could not be written to .*No space left"):
                rollouts(team, callback, k)
        # What it was to hold is there in memory
        assert callback.last.content == b"200 exact" and callback.last.path is None
        rollouts(team, callback, 250)
        with pytest.raises(OSError, match="No space left"):
            callback.save_last()
    rollouts(team, callback, 300)
    assert names(tmp_path) == ["team_0_steps.zip", "team_300_steps.zip"]


def test_a_state_that_cannot_be_exact_is_said_once(tmp_path, clock):
    team = FakeTeam()
    team.error = ValueError("it has a lambda")
    _, callback = start(tmp_path, team, save_freq=100)
    with pytest.warns(UserWarning, match="cannot be continued exactly, its checkpoints hold the models only: it has a lambda"):
        rollouts(team, callback, 0)
    rollouts(team, callback, 100)
    assert (tmp_path / "team_100_steps.zip").read_bytes() == b"100"
    assert callback.save_now() is None


def test_a_later_error_is_raised(tmp_path, clock):
    """For instance that a weight is no number any more: the state before it stays."""
    team, callback = start(tmp_path, save_freq=100)
    rollouts(team, callback, 0)
    team.error = ValueError("NaN in the weights of agent_0")
    with pytest.raises(ValueError, match="NaN"):
        rollouts(team, callback, 100)
    assert callback.last.content == b"0 exact"


def test_the_end_of_a_training_is_a_checkpoint_too(tmp_path, clock):
    team, callback = start(tmp_path, save_freq=100)
    rollouts(team, callback, 0, 100)
    team.num_timesteps = 180
    assert callback.save_now() == tmp_path / "team_180_steps.zip"
    assert callback.save_now().read_bytes() == b"180 exact"
    assert names(tmp_path) == ["team_100_steps.zip", "team_180_steps.zip"]
    assert team.saves == [(0, True), (100, True), (180, True)]


def test_a_crash_while_a_checkpoint_is_written_leaves_those_before(tmp_path, clock, monkeypatch):
    (tmp_path / "team_300_steps.zip").write_bytes(b"of an earlier try")
    team, callback = start(tmp_path, save_freq=100)
    rollouts(team, callback, 200)
    with recorded(tmp_path, monkeypatch) as disk:
        rollouts(team, callback, 300)
    check_old_or_new(disk, "team_300_steps.zip", b"of an earlier try", b"300 exact")
    assert all(files["team_200_steps.zip"] == b"200 exact" for k in range(len(disk.steps)) for files in disk.after_crashes(k))
