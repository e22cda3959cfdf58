"""Whatever ends a training, there is a team that loads, a true record, and the right exit status; and the run can go on."""

import errno
import json
import os
import signal
import tempfile
import threading
import warnings

import pytest

import sb3_belief.common.durable_files as durable_files
from sb3_belief.cli.main import train_main
from sb3_belief.team import Team
from sb3_belief.zoo.endings import EndSignals, Interrupted, SignalCheck, save_somewhere, write_traceback
from sb3_belief.zoo.errors import RunFailed
from tests.zoo import interrupted
from tests.zoo.runs import SETTINGS, TOTAL, WORDS, check_same_run, record_of, run_folder, train

pytestmark = pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
STATUS = {"SIGINT": 130, "SIGTERM": 143, "SIGHUP": 129}
# Joint steps of the last good state when the signal comes: that of the last beginning of a rollout
REACHED = {"rollout": 160, "update": 160, "evaluation": 80, "checkpoint": 160}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    status, run = train(tmp_path_factory.mktemp("undisturbed"))
    assert status == 0
    return run


def interrupt(folder, moment, name, times=1):
    """Run a training in a process of its own that is hit by a signal."""
    result = interrupted.run_interrupted(moment, name, [*WORDS, "-f", str(folder), "-params", *SETTINGS], times)
    return result, run_folder(folder)


@pytest.mark.parametrize(
    ("moment", "name", "times"),
    [
        *((moment, "SIGTERM", 1) for moment in REACHED),
        ("rollout", "SIGINT", 1),
        ("update", "SIGHUP", 1),
        ("rollout", "SIGTERM", 2),
        ("update", "SIGINT", 2),
        ("checkpoint", "SIGTERM", 2),
    ],
)
def test_a_signal_leaves_a_team_and_a_true_record_and_the_run_goes_on(tmp_path, undisturbed, moment, name, times):
    result, run = interrupt(tmp_path, moment, name, times)
    assert result.returncode == STATUS[name], result.stderr
    record = record_of(run)
    assert (record["status"], record["signal"], record["timesteps"]) == ("interrupted", name, REACHED[moment])
    assert Team.load(run / "team.zip").num_timesteps == REACHED[moment]
    assert f"Interrupted by {name}" in result.stdout and f"--resume {run}" in result.stdout
    assert ("A further signal ends the program" in result.stderr) == (times == 2)
    assert not list(run.rglob("*.tmp")) and not (run / ".lock").exists()
    # As if it had never happened
    assert train_main(["--resume", str(run)]) == 0
    assert record_of(run)["status"] == "finished" and record_of(run)["timesteps"] == TOTAL
    assert "signal" not in record_of(run)
    check_same_run(run, undisturbed)


def test_a_signal_in_the_final_save_does_not_break_it(tmp_path, undisturbed):
    result, run = interrupt(tmp_path, "end", "SIGTERM")
    assert result.returncode == 0 and "A further signal ends the program" in result.stderr
    assert (record_of(run)["status"], record_of(run)["timesteps"]) == ("finished", TOTAL)
    check_same_run(run, undisturbed)


def test_a_third_signal_ends_at_once(tmp_path):
    result, run = interrupt(tmp_path, "rollout", "SIGTERM", 3)
    assert result.returncode == 143
    # As after a kill: whatever the save was at, the old files are there, and the record does not say that it has ended well
    assert record_of(run)["status"] == "running"
    assert train_main(["--resume", str(run)]) == 0
    assert Team.load(run / "team.zip").num_timesteps == TOTAL
    assert not list(run.rglob("*.tmp"))


# In this process


def at_step(monkeypatch, steps, action):
    """Have something happen in the training at a number of joint steps."""
    monkeypatch.setattr(SignalCheck, "_on_step", lambda self: self.num_timesteps != steps or action(self) or True)


def fail_with(error):
    def fail(*_, **__):
        raise error

    return fail


@pytest.mark.parametrize(
    "error", [ValueError("NaN in the loss"), MemoryError("too much"), RuntimeError("worker 3 died"), SystemExit(5)]
)
def test_an_error_leaves_the_last_good_state_and_says_so(tmp_path, monkeypatch, capsys, undisturbed, error):
    with monkeypatch.context() as patched:
        at_step(patched, 200, fail_with(error))
        status, run = train(tmp_path)
    assert status == 1
    record, said = record_of(run), capsys.readouterr().err
    assert (record["status"], record["timesteps"]) == ("failed", 160)
    assert str(error) in record["error"] and str(error) in said
    assert said.startswith("Failed: The training failed after 200 joint steps") and said.count("\n") == 1
    for part in (str(run / "team.zip"), "the state at 160 joint steps", str(run / "error.txt"), f"--resume {run}"):
        assert part in said
    assert "Traceback" in (run / "error.txt").read_text() and "test_endings.py" in (run / "error.txt").read_text()
    assert Team.load(run / "team.zip").num_timesteps == 160
    assert train_main(["--resume", str(run)]) == 0
    assert "error" not in record_of(run)
    check_same_run(run, undisturbed)


def test_a_failed_training_raises_for_programs(tmp_path, monkeypatch):
    from sb3_belief.zoo.config import load_config
    from sb3_belief.zoo.train import TrainOptions
    from sb3_belief.zoo.train import train as train_run

    error = KeyError("lost")
    at_step(monkeypatch, 200, fail_with(error))
    config = load_config("ppo", "traffic-junction-easy", params=SETTINGS, n_timesteps=400)
    with pytest.raises(RunFailed, match="lost") as caught:
        train_run(config, TrainOptions(seed=0, log_folder=str(tmp_path), verbose=0, eval_freq=-1))
    assert caught.value.__cause__ is error


def full_for(is_full):
    """Return an ``os.fsync`` for a disk that is full for the files whose paths say so."""
    real = os.fsync

    def fsync(descriptor):
        if is_full(os.readlink(f"/proc/self/fd/{descriptor}")):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(descriptor)

    return fsync


needs_proc = pytest.mark.skipif(not os.path.exists("/proc/self/fd"), reason="needs /proc")


@needs_proc
def test_a_full_disk_at_a_checkpoint_warns_and_training_goes_on(tmp_path, monkeypatch, undisturbed):
    monkeypatch.setattr(durable_files.os, "fsync", full_for(lambda path: "team_160_" in path or "team_240_" in path))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        status, run = train(tmp_path)
    assert status == 0
    said = [str(each.message) for each in caught if "checkpoint" in str(each.message)]
    assert [text[:37] for text in said] == ["The checkpoint at 160 joint steps cou", "The checkpoint at 240 joint steps cou"]
    assert all("No space left on device" in text and "goes on without it" in text for text in said)
    assert sorted(path.name for path in (run / "checkpoints").iterdir()) == ["team_320_steps.zip", "team_400_steps.zip"]
    check_same_run(run, undisturbed)


@needs_proc
@pytest.mark.parametrize("interrupted", [False, True])
def test_a_full_disk_at_the_final_save_finds_another_place(tmp_path, monkeypatch, capfd, interrupted):
    elsewhere = tmp_path / "temporary"
    elsewhere.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(elsewhere))
    is_full = []

    def fill(_):
        is_full.append(True)
        if interrupted:
            terminate()

    # From the last steps on
    at_step(monkeypatch, 200 if interrupted else TOTAL, fill)
    logs = f"{tmp_path}/ppo/"
    monkeypatch.setattr(durable_files.os, "fsync", full_for(lambda path: bool(is_full) and path.startswith(logs)))
    status, run = train(tmp_path, "--eval-freq", "-1")
    assert status == (143 if interrupted else 0)
    team, said = elsewhere / "ppo_traffic-junction-easy_1_team.zip", capfd.readouterr().err
    assert f"{run / 'team.zip'} could not be written (No space left on device)" in said
    assert f"{run.parent / team.name} could not be written" in said and f"saved as {team} instead" in said
    assert Team.load(team).num_timesteps == (160 if interrupted else TOTAL)
    assert f"{run / 'run.json'} could not be written" in said
    assert not (run / "team.zip").exists() and not list(tmp_path.rglob("*.tmp"))


@needs_proc
def test_where_the_team_is_instead_is_in_the_record(tmp_path, monkeypatch):
    monkeypatch.setattr(durable_files.os, "fsync", full_for(lambda path: "easy_1/.team.zip" in path))
    status, run = train(tmp_path, "--eval-freq", "-1")
    assert status == 0 and record_of(run)["saved"] == str(tmp_path / "ppo" / "ppo_traffic-junction-easy_1_team.zip")


def terminate():
    os.kill(os.getpid(), signal.SIGTERM)


def test_nothing_is_lost_before_the_first_state(tmp_path, monkeypatch, capsys):
    """An error before the first rollout: the team is saved as it is."""
    monkeypatch.setattr("sb3_belief.team.checkpoints.Checkpoints._on_rollout_start", fail_with(ValueError("too early")))
    status, run = train(tmp_path)
    assert status == 1 and record_of(run)["timesteps"] == 0
    assert Team.load(run / "team.zip").num_timesteps == 0
    assert "--resume" not in capsys.readouterr().err


# Signals


def test_handlers_are_put_back():
    before = {name: signal.getsignal(getattr(signal, name)) for name in STATUS}
    with EndSignals():
        assert all(signal.getsignal(getattr(signal, name)) != before[name] for name in ("SIGTERM", "SIGHUP"))
    assert {name: signal.getsignal(getattr(signal, name)) for name in STATUS} == before


def test_what_is_ignored_stays_ignored():
    """A program under nohup does not end with its terminal."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with EndSignals():
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
            os.kill(os.getpid(), signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


def test_other_threads_leave_signals_alone():
    before = signal.getsignal(signal.SIGTERM)
    seen = []

    def run():
        with EndSignals():
            seen.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert seen == [before]


@pytest.mark.parametrize(("name", "status"), STATUS.items())
def test_a_signal_is_an_exception_with_its_name_and_exit_status(name, status):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with EndSignals(), pytest.raises(Interrupted) as caught:
            os.kill(os.getpid(), getattr(signal, name))
    finally:
        signal.signal(signal.SIGINT, before)
    assert isinstance(caught.value, KeyboardInterrupt)
    assert (caught.value.signal_name, caught.value.exit_status) == (name, status)


def test_an_exception_that_was_lost_in_a_finaliser_is_raised_at_the_next_step():
    class Finalised:
        def __del__(self):
            os.kill(os.getpid(), signal.SIGTERM)

    with warnings.catch_warnings(), EndSignals() as signals:
        warnings.simplefilter("ignore", pytest.PytestUnraisableExceptionWarning)
        thing = Finalised()
        del thing
        with pytest.raises(Interrupted):
            SignalCheck(signals)._on_step()


def test_while_saving_signals_wait(capfd):
    with EndSignals() as signals:
        signals.hold()
        os.kill(os.getpid(), signal.SIGTERM)
        signals.check()
    assert capfd.readouterr().err == "Saving. A further signal ends the program at once, without.\n"


def hit_as_another_error(*_, **__):
    """Be hit by SIGTERM where a class is made: until Python 3.12, what the handler raises arrives as a RuntimeError."""
    try:
        os.kill(os.getpid(), signal.SIGTERM)
    except Interrupted as error:
        raise RuntimeError("Error calling __set_name__ on 'cached_property' instance") from error


def test_an_error_after_a_signal_is_the_signal():
    with pytest.raises(Interrupted) as caught, EndSignals():
        hit_as_another_error()
    assert caught.value.exit_status == 143 and isinstance(caught.value.__cause__, RuntimeError)
    # What is raised after the save is not the signal that came meanwhile
    with pytest.raises(ValueError, match="the training failed"), EndSignals() as signals:
        signals.hold()
        os.kill(os.getpid(), signal.SIGTERM)
        raise ValueError("the training failed")


def test_a_signal_that_arrives_as_another_error_in_a_training(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(SignalCheck, "_on_step", lambda self: self.num_timesteps < 200 or hit_as_another_error())
    status, run = train(tmp_path)
    assert status == 143 and not (run / "error.txt").exists()
    assert (record_of(run)["status"], record_of(run)["signal"]) == ("interrupted", "SIGTERM")
    assert "Interrupted by SIGTERM" in capsys.readouterr().out


def test_a_signal_that_arrives_as_another_error_before_a_training(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sb3_belief.zoo.train.make_team", hit_as_another_error)
    assert train_main([*WORDS, "-f", str(tmp_path), "-params", *SETTINGS]) == 143
    assert capsys.readouterr().err == "Interrupted.\n" and not list(tmp_path.rglob("*_1"))


def test_a_signal_while_a_checkpoint_is_loaded_does_not_make_it_a_damaged_one(tmp_path, undisturbed, monkeypatch, capsys):
    result, run = interrupt(tmp_path, "rollout", "SIGTERM")
    assert result.returncode == 143
    before = (run / "run.json").read_bytes()
    with monkeypatch.context() as patched:
        patched.setattr(Team, "load", hit_as_another_error)
        assert train_main(["--resume", str(run)]) == 143
    assert capsys.readouterr().err == "Interrupted.\n" and (run / "run.json").read_bytes() == before
    assert train_main(["--resume", str(run)]) == 0
    check_same_run(run, undisturbed)


# Pieces


def test_a_traceback_that_cannot_be_written_is_no_second_error(tmp_path):
    error = ValueError("ä")
    assert write_traceback(tmp_path, error) == tmp_path / "error.txt"
    assert "ValueError: ä" in (tmp_path / "error.txt").read_text(encoding="utf-8")
    assert write_traceback(tmp_path / "nowhere", error) is None


def test_a_file_for_which_there_is_no_place(tmp_path, capfd):
    assert save_somewhere(tmp_path / "run" / "team.zip", fail_with(OSError(errno.ENOSPC, "full"))) is None
    assert capfd.readouterr().err.count("could not be written (full)") == 3


def test_what_is_saved_elsewhere_takes_no_other_files_place(tmp_path, monkeypatch, capfd):
    """Two runs of one name on two full disks have the same place elsewhere."""
    elsewhere = tmp_path / "tmp"
    elsewhere.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(elsewhere))
    for folder, names in (("one", ["ppo_game_1_team.zip"]), ("two", ["ppo_game_1_team.zip", "ppo_game_1_team_2.zip"])):

        def write(place, content=folder):
            if place.parent != elsewhere:
                raise OSError(errno.ENOSPC, "full")
            place.write_text(content)

        saved = save_somewhere(tmp_path / folder / "ppo" / "game_1" / "team.zip", write)
        assert saved == elsewhere / names[-1] and (elsewhere / names[-1]).read_text() == folder
        assert sorted(path.name for path in elsewhere.iterdir()) == names
        assert f"saved as {saved} instead" in capfd.readouterr().err
    # Nothing is left where it could not be written
    assert save_somewhere(tmp_path / "ppo" / "game_1" / "team.zip", fail_with(OSError(errno.ENOSPC, "full"))) is None
    assert len(list(elsewhere.iterdir())) == 2 and not list(tmp_path.glob("ppo/*"))


def test_the_moments_of_the_driver_are_those_of_the_tests():
    assert set(REACHED) | {"end"} == set(interrupted.MOMENTS)


def test_the_record_is_json_to_the_end(undisturbed):
    assert json.loads((undisturbed / "run.json").read_text())["options"]["save_every"] == 600.0
