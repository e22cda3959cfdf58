"""A run that was killed goes on from its newest whole checkpoint, and leaves what an undisturbed run would have left."""

import json
import multiprocessing
import os
import shutil
import time

import numpy as np
import pytest
import yaml

from sb3_belief.cli.main import main, train_main
from sb3_belief.team import Team, TeamVecEnv
from sb3_belief.zoo.endings import Interrupted, SignalCheck
from sb3_belief.zoo.errors import ConfigError
from sb3_belief.zoo.resume import resume_config
from sb3_belief.zoo.run_folder import find_team, whole_checkpoints
from sb3_belief.zoo.run_lock import run_lock
from sb3_belief.zoo.train_options import TrainOptions
from tests.zoo.interrupted import run_interrupted
from tests.zoo.runs import EASY, SETTINGS, TOTAL, WORDS, check_same_run, record_of, run_folder, table, train


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    status, run = train(tmp_path_factory.mktemp("undisturbed"))
    assert status == 0
    return run


def kill(folder, moment, words):
    """Run a training in a process of its own that is killed at a moment."""
    result = run_interrupted(moment, "SIGKILL", [*words, "-f", str(folder)])
    assert result.returncode == -9, result.stderr
    return run_folder(folder)


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize("moment", ["rollout", "update", "evaluation", "checkpoint", "end"])
def test_a_killed_run_goes_on_to_the_same_end(tmp_path, undisturbed, moment):
    run = kill(tmp_path, moment, [*WORDS, "-params", *SETTINGS])
    assert record_of(run)["status"] == "running"
    # The file that was being written
    assert len(list(run.rglob("*.tmp"))) == (moment in ("checkpoint", "end"))
    assert main(["train", "--resume", str(run)]) == 0
    assert not list(run.rglob("*.tmp"))
    record = record_of(run)
    assert (record["status"], record["timesteps"], len(record["resumed"])) == ("finished", TOTAL, 1)
    assert record["command"] == record_of(run)["command"] and "--resume" in record["resumed"][0]["command"]
    check_same_run(run, undisturbed)


VARIANTS = {
    # The second agent begins a rollout every 120 joint steps, the others every 80
    "rollouts of two lengths": ["-params", "n_envs:4", "agent_kwargs:{car_1: {n_steps: 30}}"],
    "subproc, jobs, normalize": ["--vec-env", "subproc", "--jobs", "2", "-params", "n_envs:2", "normalize:true"],
    "belief": ["--algo", "belief_ppo", "-params", "n_envs:4", "history_length:40"],
    "mpe": ["--env", "mpe/simple_spread_v3", "-params", "n_envs:4"],
}


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize("name", VARIANTS)
def test_so_does_one_with_other_settings(tmp_path, name):
    words = [*WORDS, *VARIANTS[name], "n_steps:20", "batch_size:40", "n_epochs:1"]
    assert train_main([*words, "-f", str(tmp_path / "undisturbed")]) == 0
    run = kill(tmp_path / "killed", "rollout", words)
    assert train_main(["--resume", str(run)]) == 0
    check_same_run(run, run_folder(tmp_path / "undisturbed"))


def stop_at(monkeypatch, steps):
    """Have the training fail at a number of joint steps."""

    def step(self):
        if self.num_timesteps == steps:
            raise OSError("power failure")
        return True

    monkeypatch.setattr(SignalCheck, "_on_step", step)


def stopped(folder, steps, *words):
    """Return a run that failed at a number of joint steps."""
    with pytest.MonkeyPatch.context() as patched:
        stop_at(patched, steps)
        status, run = train(folder, *words)
    assert status == 1
    return run


def test_a_run_may_be_stopped_again_and_again(tmp_path, undisturbed, monkeypatch):
    run = stopped(tmp_path, 100)
    for steps in (180, 200, 300, 380):
        with monkeypatch.context() as patched:
            stop_at(patched, steps)
            assert train_main(["--resume", str(run)]) == 1
    assert train_main(["--resume", str(run)]) == 0
    assert len(record_of(run)["resumed"]) == 5
    check_same_run(run, undisturbed)


@pytest.mark.parametrize("damage", ["cut", "flipped", "emptied"])
def test_a_damaged_checkpoint_is_said_and_the_one_before_is_taken(tmp_path, undisturbed, capsys, damage):
    run = stopped(tmp_path, 300)
    newest = run / "checkpoints" / "team_240_steps.zip"
    content = bytearray(newest.read_bytes())
    if damage == "flipped":
        content[len(content) // 2] ^= 16
    newest.write_bytes({"cut": content[:-100], "flipped": content, "emptied": b""}[damage])
    capsys.readouterr()
    assert train_main(["--resume", str(run), "--verbose", "1"]) == 0
    said = capsys.readouterr()
    assert f"{newest} is damaged" in said.err and "an earlier checkpoint is looked for" in said.err
    assert f"Run folder: {run}  (seed 3), from team_160_steps.zip to {TOTAL} joint steps" in said.out
    check_same_run(run, undisturbed)


def test_without_a_whole_checkpoint_there_is_nothing_to_go_on_from(tmp_path, capsys):
    run = stopped(tmp_path, 100)
    for path in (run / "checkpoints").iterdir():
        path.write_bytes(b"PK")
    before = sorted((path, path.stat().st_mtime_ns) for path in run.rglob("*.*"))
    assert train_main(["--resume", str(run)]) == 2
    assert "Refused: --resume: no checkpoint of" in capsys.readouterr().err
    assert sorted((path, path.stat().st_mtime_ns) for path in run.rglob("*.*")) == before


def test_a_finished_run_says_so_and_can_be_extended(tmp_path, undisturbed, capsys):
    """To twice the steps, in two parts, as in one: with constant settings nothing depends on where the end is."""
    run = tmp_path / "run"
    shutil.copytree(undisturbed, run)
    assert train_main(["--resume", str(run)]) == 0
    assert f"{run} has finished, at {TOTAL} joint steps. --until STEPS trains it further." in capsys.readouterr().out
    check_same_run(run, undisturbed)
    constant = [*SETTINGS, "learning_rate:1e-3", "clip_range:0.2"]
    for name, steps in (("long", 640), ("short", 320)):
        assert train(tmp_path / name, "-n", str(steps), settings=constant)[0] == 0
    long, short = (run_folder(tmp_path / name) for name in ("long", "short"))
    assert train_main(["--resume", str(short), "--until", "640"]) == 0
    check_same_run(short, long)
    assert record_of(short)["total_timesteps"] == 640
    assert yaml.safe_load((short / "config.yml").read_text()) == yaml.safe_load((long / "config.yml").read_text())


def test_a_run_that_was_killed_when_all_was_learned_is_finished(tmp_path, undisturbed):
    run = tmp_path / "run"
    shutil.copytree(undisturbed, run)
    (run / "team.zip").unlink()
    (run / "run.json").write_text(json.dumps({**record_of(run), "status": "running"}))
    assert train_main(["--resume", str(run)]) == 0
    assert (record_of(run)["status"], record_of(run)["timesteps"]) == ("finished", TOTAL)
    check_same_run(run, undisturbed)


def test_an_unfinished_run_can_be_extended(tmp_path):
    run = stopped(tmp_path, 100)
    assert train_main(["--resume", str(run), "--until", "480"]) == 0
    assert record_of(run)["timesteps"] == Team.load(run / "team.zip").num_timesteps == 480


def test_a_run_that_went_on_from_a_saved_team_goes_on_too(tmp_path, undisturbed):
    """Its steps count on from those of the run before."""
    words = ["-i", str(undisturbed), "-n", "240", "--seed", "5", "--verbose", "0", "--save-freq", "80", "--eval-freq", "160"]
    words += ["--eval-episodes", "6", "--n-eval-envs", "3"]
    assert train_main([*words, "-f", str(tmp_path / "undisturbed")]) == 0
    with pytest.MonkeyPatch.context() as patched:
        stop_at(patched, TOTAL + 180)
        assert train_main([*words, "-f", str(tmp_path / "stopped")]) == 1
    run = run_folder(tmp_path / "stopped")
    assert train_main(["--resume", str(run)]) == 0
    assert record_of(run)["timesteps"] == TOTAL + 240
    check_same_run(run, run_folder(tmp_path / "undisturbed"))


def test_tensorboard_goes_on(tmp_path):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    run = stopped(tmp_path / "logs", 300, "-tb", str(tmp_path / "tb"))
    # TensorBoard orders the files of a run by the second of their beginning
    time.sleep(1.1)
    assert train_main(["--resume", str(run)]) == 0
    (folder,) = (tmp_path / "tb" / "ppo" / EASY).iterdir()
    for events, expected in ((folder, [80, 160, 240, 320, 400]), (folder / "agents" / "car_0", [80, 160, 240, 320, 400])):
        scalars = accumulator.EventAccumulator(str(events)).Reload().Scalars("rollout/ep_rew_mean")
        assert [scalar.step for scalar in scalars] == expected


def test_a_run_moves_with_its_folder(tmp_path, undisturbed):
    run = stopped(tmp_path / "here", 300)
    there = tmp_path / "there" / "renamed"
    shutil.move(run, there)
    assert train_main(["--resume", str(there)]) == 0
    assert not run.exists()
    check_same_run(there, undisturbed)


# What is refused


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--resume", "RUN", "--seed", "3"], "--seed: with --resume a run goes on with the settings that it had"),
        (["--resume", "RUN", "-n", "10", "-params", "n_envs:2"], "--n-timesteps, -params: with --resume"),
        # Its default, which the run may not have had
        (["--resume", "RUN", "--eval-freq", "25000"], "--eval-freq: with --resume"),
        (["--resume", "RUN", "--until", "100"], "--until: the run RUN goes to 400 joint steps: name more, not 100"),
        (["--resume", "RUN", "--until", "400"], "--until: the run RUN goes to 400 joint steps: name more, not 400"),
        (["--until", "100"], "--until: extends a run, which is named by --resume"),
        (["--resume", "RUN/team.zip"], "'RUN/team.zip' is not the folder of a run: it has no run.json"),
        (["--resume", "nowhere"], "'nowhere' is not the folder of a run"),
        (["--save-every", "10x"], "must be a time such as 90s, 10m or 2h, or -1 for never, not '10x'"),
        (["--save-every", "0"], "must be a time such as"),
    ],
)
def test_what_cannot_be_resumed_is_refused(words, message, undisturbed, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    before = record_of(undisturbed)
    try:
        assert train_main([word.replace("RUN", str(undisturbed)) for word in words]) == 2
    except SystemExit as exit_:
        assert exit_.code == 2
    said = capsys.readouterr().err
    assert said.startswith("Refused: ") and message.replace("RUN", str(undisturbed)) in said
    assert record_of(undisturbed) == before and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"options": None}, "does not hold the run's options"),
        ({"options": {"seed": "3"}}, "seed cannot be '3': the file is damaged"),
        ({"options": {"jobs": True}}, "jobs cannot be True"),
        ({"options": {"trust": True}}, "there is no option 'trust' in this version"),
        ({"options": {"extra_packages": ["os"]}}, "there is no option 'extra_packages'"),
        ({"options": {"seed": None}}, "does not hold the run's seed"),
        ({"total_timesteps": None}, "does not say 'total_timesteps'"),
        ({"env": 3}, "does not say which 'algo' and 'env' the run had"),
    ],
)
def test_a_damaged_record_is_refused(change, message, undisturbed, tmp_path, capsys):
    run = tmp_path / "run"
    shutil.copytree(undisturbed, run)
    (run / "run.json").write_text(json.dumps({**record_of(run), "status": "running", **change}))
    assert train_main(["--resume", str(run)]) == 2
    assert message in capsys.readouterr().err


def test_options_that_do_not_change_what_is_learned_may_be_given(tmp_path, undisturbed):
    run = stopped(tmp_path, 300)
    words = ["--verbose", "0", "--jobs", "2", "--num-threads", "1", "--device", "cpu"]
    assert train_main(["--resume", str(run), *words]) == 0
    record = record_of(run)
    assert (record["jobs"], record["device"], record["options"]["jobs"]) == (2, "cpu", 2)
    check_same_run(run, undisturbed)


def _hold(folder, pipe):
    with run_lock(folder):
        pipe.send("held")
        pipe.recv()


def test_a_run_is_trained_by_one_process(tmp_path, capsys):
    run = stopped(tmp_path, 100)
    here, there = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(target=_hold, args=(run, there))
    process.start()
    assert here.recv() == "held"
    before = record_of(run)
    assert train_main(["--resume", str(run)]) == 2
    assert f"this run is being trained by process {process.pid} on " in capsys.readouterr().err
    assert record_of(run) == before
    # A killed one holds nothing
    process.kill()
    process.join()
    assert (run / ".lock").exists()
    assert train_main(["--resume", str(run)]) == 0
    assert not (run / ".lock").exists()


def test_a_run_that_trains_is_held(tmp_path, monkeypatch):
    held = []

    def step(self):
        if self.num_timesteps == 100:
            with (
                pytest.raises(ConfigError, match=f"is being trained by process {os.getpid()}"),
                run_lock(run_folder(tmp_path)),
            ):
                pass
            held.append(True)
        return True

    monkeypatch.setattr(SignalCheck, "_on_step", step)
    assert train(tmp_path)[0] == 0
    assert held == [True]


# What the other commands make of an unfinished run


def test_others_take_the_newest_checkpoint_of_an_unfinished_run(tmp_path, capsys, monkeypatch):
    run = stopped(tmp_path / "logs", 300)
    assert find_team(run, "enjoy") == run / "team.zip"
    assert capsys.readouterr().err.count(f"{run} has not finished (failed): team.zip is taken.") == 1
    # With -i it is said where the team is taken, and not where its settings are read before
    resume_config(str(run))
    assert capsys.readouterr().err == ""
    # Killed: there is no team, or one of before
    (run / "run.json").write_text(json.dumps({**record_of(run), "status": "running"}))
    newest = run / "checkpoints" / "team_240_steps.zip"
    for _ in range(2):
        assert find_team(run, "enjoy") == newest
        assert "(running): checkpoints/team_240_steps.zip is taken.\n" in capsys.readouterr().err
        (run / "team.zip").unlink(missing_ok=True)
    assert find_team(run, "--trained-agent") == newest
    assert f"What -i trains is a new run; train --resume {run} continues this one exactly." in capsys.readouterr().err
    monkeypatch.chdir(tmp_path)
    assert main(["export", f"{run}:car_0", "--format", "torch"]) == 0
    assert main(["enjoy", str(run), "-n", "3", "--output", str(tmp_path / "a.gif")]) == 0
    newest.write_bytes(newest.read_bytes()[:-50])
    capsys.readouterr()
    assert find_team(run, "enjoy") == run / "checkpoints" / "team_160_steps.zip"
    assert f"{newest} is damaged" in capsys.readouterr().err


def test_a_signal_before_the_training_begins_is_no_failure(tmp_path, undisturbed, monkeypatch, capsys):
    run = stopped(tmp_path, 300)

    def start_monitor(*_, **__):
        raise Interrupted(15)

    with monkeypatch.context() as patched:
        patched.setattr(TeamVecEnv, "start_monitor", start_monitor)
        assert train_main(["--resume", str(run)]) == 143
    record = record_of(run)
    assert (record["status"], record["signal"]) == ("interrupted", "SIGTERM")
    assert "error" not in record and "timesteps" not in record
    # The team is that of an earlier end
    assert find_team(run, "enjoy") == run / "checkpoints" / "team_240_steps.zip"
    assert train_main(["--resume", str(run)]) == 0
    check_same_run(run, undisturbed)


def test_i_of_an_unfinished_run_begins_a_new_one(tmp_path, capsys):
    run = stopped(tmp_path / "logs", 300)
    (run / "team.zip").unlink()
    words = ["-i", str(run), "-n", "80", "-f", str(tmp_path / "new"), "--verbose", "0", "--eval-freq", "-1"]
    assert train_main(words) == 0
    assert f"train --resume {run} continues this one exactly" in capsys.readouterr().err
    assert record_of(run_folder(tmp_path / "new"))["timesteps"] == 240 + 80


def test_checkpoints_are_sorted_as_numbers(tmp_path):
    folder = tmp_path / "checkpoints"
    folder.mkdir()
    for steps in (80, 900, 1000, 20_000):
        shutil.make_archive(str(folder / f"team_{steps}_steps"), "zip", _with_manifest(tmp_path))
    assert [path.name for path in whole_checkpoints(tmp_path)] == [f"team_{k}_steps.zip" for k in (20_000, 1000, 900, 80)]


def _with_manifest(folder):
    content = folder / "content"
    content.mkdir(exist_ok=True)
    (content / "team.json").write_text("{}")
    return content


def test_options_survive_the_record():
    options = TrainOptions(seed=3, save_every=90.0, tensorboard_log="tb", extra_packages=("a",), trust=True, verbose=0)
    recorded = json.loads(json.dumps(options.to_record()))
    again = TrainOptions.from_record(recorded, "run.json", verbose=2)
    assert (again.seed, again.save_every, again.verbose, again.jobs) == (3, 90.0, 2, 1)
    # Whom the user trusts no file says
    assert (again.extra_packages, again.trust) == ((), False)
    assert again.tensorboard_log == os.path.abspath("tb")


def test_evaluations_do_not_depend_on_those_before(tmp_path):
    """The second of two evaluations is the only one of a run that has one at that step alone."""
    for name, freq in (("both", "160"), ("second", "320")):
        assert train(tmp_path / name, "-n", "320", "--eval-freq", freq)[0] == 0
    both, second = (np.load(run_folder(tmp_path / name) / "evaluations.npz") for name in ("both", "second"))
    np.testing.assert_array_equal(both["results"][1], second["results"][0])
    assert not np.array_equal(both["results"][0], both["results"][1])
    assert len(table(run_folder(tmp_path / "both") / "progress.csv")) == 4 + 2
