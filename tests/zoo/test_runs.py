import json
import os
from importlib import metadata

import numpy as np
import pytest
import yaml

from sb3_belief.cli.main import main, train_main
from sb3_belief.envs import TrafficJunction
from sb3_belief.envs.traffic_junction.vec_env import TrafficJunctionVecEnv
from sb3_belief.team import Team, make_team_env
from tests.zoo.runs import table

EASY = "traffic-junction-easy"
# small enough for seconds, large enough for two iterations
TINY = {
    "ppo": ["n_envs:4", "n_steps:20", "batch_size:40", "n_epochs:1"],
    "belief_ppo": ["n_envs:4", "n_steps:20", "batch_size:40", "n_epochs:1", "history_length:40"],
}


def train_tiny(algo, folder, *words):
    flags = ["--env", EASY, "--seed", "3", "-f", str(folder), "--verbose", "0", "--eval-freq", "-1", "-params", *TINY[algo]]
    return train_main(["--algo", algo, *flags, *words])


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished run of PPO: its folder, with everything that a run can write."""
    folder = tmp_path_factory.mktemp("runs")
    words = ["-n", "160", "--eval-freq", "80", "--eval-episodes", "6", "--n-eval-envs", "3", "--save-freq", "80"]
    assert train_tiny("ppo", folder / "logs", *words, "-tb", str(folder / "tb")) == 0
    return folder / "logs" / "ppo" / f"{EASY}_1"


def test_a_run_writes_its_configuration_and_record(run):
    settings = yaml.safe_load((run / "config.yml").read_text())[EASY]
    assert (settings["n_timesteps"], settings["n_steps"], settings["env_kwargs"]) == (160, 20, {"reward_scale": 0.1})
    record = json.loads((run / "run.json").read_text())
    assert (record["status"], record["algo"], record["env"], record["seed"]) == ("finished", "ppo", EASY, 3)
    assert record["timesteps"] == 160 and record["versions"]["torch"]
    assert record["command"].startswith("python train.py --algo ppo --env traffic-junction-easy --seed 3")


def test_a_run_writes_monitors_of_the_team_and_of_each_agent(run):
    team = table(run / "monitor.csv", skip=1)
    assert [row["l"] for row in team] == ["20"] * 8  # 160 joint steps
    agents = {f"car_{i}": table(run / "agents" / f"car_{i}.monitor.csv", skip=1) for i in range(5)}
    # the team's reward is the mean of its agents'
    mean = np.mean([[float(row["r"]) for row in rows] for rows in agents.values()], axis=0)
    np.testing.assert_allclose([float(row["r"]) for row in team], mean, atol=1e-5)
    for i in range(5):
        assert len(table(run / "agents" / f"car_{i}" / "progress.csv")) == 2


def test_a_run_writes_progress_evaluations_and_tensorboard(run):
    assert {int(row["time/total_timesteps"]) for row in table(run / "progress.csv")} >= {80, 160}
    with np.load(run / "evaluations.npz") as data:
        assert data["timesteps"].tolist() == [80, 160]
        assert data["results"].shape == data["successes"].shape == (2, 6)
    events = (run.parents[2] / "tb" / "ppo" / EASY / "Team_1").rglob("events.out*")
    assert len(list(events)) == 6  # the team and five cars


@pytest.mark.parametrize("name", ["team", "best_model", "checkpoints/team_80_steps", "checkpoints/team_160_steps"])
def test_a_run_writes_teams_that_load(run, name):
    team = Team.load(run / f"{name}.zip")
    assert list(team.agents) == [f"car_{i}" for i in range(5)]
    obs = make_team_env(EASY, n_envs=2, seed=0).reset()
    actions, _ = team.predict(obs, deterministic=True)
    assert actions["car_4"].shape == (2,)


def test_the_same_seed_gives_the_same_run(tmp_path):
    for _ in range(2):
        assert train_tiny("ppo", tmp_path, "-n", "160") == 0
    first, second = (table(tmp_path / "ppo" / f"{EASY}_{k}" / "monitor.csv", skip=1) for k in (1, 2))
    assert [row["r"] for row in first] == [row["r"] for row in second]


def test_belief_ppo_runs_in_a_checkout_that_is_elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # configurations are found from any folder, runs are written to this one
    assert train_main(["--env", EASY, "-n", "160", "--eval-freq", "-1", "--verbose", "0", "-params", *TINY["belief_ppo"]]) == 0
    folder = tmp_path / "logs" / "belief_ppo" / f"{EASY}_1"
    rows = table(folder / "progress.csv")
    assert float(rows[-1]["belief/action_loss"]) > 0
    assert json.loads((folder / "run.json").read_text())["seed"] >= 0  # drawn, and written down


@pytest.mark.parametrize(
    "algo", ["ippo", "maskable_belief_ppo", "a2c", "dqn", "maskable_ppo", "recurrent_ppo", "trpo", "qrdqn"]
)
def test_every_algorithm_for_discrete_actions_runs_in_a_team(algo, tmp_path):
    small = ["n_envs:2", "policy_kwargs.net_arch:[8]"]
    if algo in ("dqn", "qrdqn"):
        small += ["learning_starts:8", "buffer_size:100", "batch_size:8"]
    else:
        small += ["n_steps:8"] + ([] if algo == "a2c" else ["batch_size:16"])
    flags = ["--env", EASY, "-n", "32", "-f", str(tmp_path), "--verbose", "0", "--eval-freq", "16", "--eval-episodes", "2"]
    assert train_main(["--algo", algo, *flags, "-params", *small]) == 0
    team = Team.load(tmp_path / algo / f"{EASY}_1" / "team.zip")
    assert team.num_timesteps >= 32


def test_a_run_goes_on_from_a_saved_team(run, tmp_path):
    words = ["-i", str(run), "-n", "80", "-f", str(tmp_path), "--verbose", "0", "--eval-freq", "-1"]
    assert main(["train", *words]) == 0
    folder = tmp_path / "ppo" / f"{EASY}_1"
    record = json.loads((folder / "run.json").read_text())
    assert (record["timesteps"], record["trained_agent"]) == (160 + 80, str(run / "team.zip"))
    before, after = (Team.load(path / "team.zip").agents["car_0"] for path in (run, folder))
    assert after._n_updates > before._n_updates
    assert vars(after)["n_steps"] == 20  # the saved run's own setting, not zoo_configs/ppo.yml's


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["-params", "n_steps:40"], "'n_steps' cannot be set with -i, the saved models keep their settings"),
        (["-params", "n_env:40"], "Did you mean 'n_envs'"),
        (["--algo", "a2c"], "'a2c' does not fit the saved team, which is of 'ppo'"),
        (["--env", "traffic-junction-medium"], "cannot be set up on traffic-junction-medium"),
    ],
)
def test_what_does_not_fit_a_saved_team_is_refused(words, message, run, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["train", "-i", str(run), "--eval-freq", "-1", *words]) == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_wrappers_change_what_the_agents_see(tmp_path):
    words = ["-n", "80", "-params", "env_wrapper:{supersuit.frame_stack_v1: {stack_size: 3}}"]
    assert train_tiny("ppo", tmp_path, *words) == 0
    folder = tmp_path / "ppo" / f"{EASY}_1"
    plain = make_team_env(EASY).reset()["car_0"].shape[1]
    assert Team.load(folder / "team.zip").agents["car_0"].observation_space.shape == (3 * plain,)
    # and the team is replayed behind the same wrapper
    output = tmp_path / "episode.gif"
    assert main(["enjoy", str(folder), "--output", str(output)]) == 0
    assert output.stat().st_size > 0


def test_visibility_says_who_is_seen(tmp_path, monkeypatch):
    (tmp_path / "blindness.py").write_text(
        "import numpy as np\ndef nobody(env, n=2):\n    return {agent: np.zeros(n, bool) for agent in env.possible_agents}\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    flags = "--env mpe2.simple_spread_v3:parallel_env -n 160 --verbose 0 --eval-freq -1".split()
    for name, settings in (("0.0", ["visibility:{blindness.nobody: {n: 2}}"]), ("1.0", [])):
        words = "--allow-package mpe2 --allow-package blindness -params".split()
        assert train_main(["-f", str(tmp_path), *flags, *words, *TINY["belief_ppo"], *settings]) == 0
        folder = max((tmp_path / "belief_ppo").iterdir(), key=lambda path: path.stat().st_mtime_ns)
        rows = table(folder / "agents" / "agent_0" / "progress.csv")
        assert rows[-1]["belief/visible_fraction"] == name


def test_a_run_notes_the_versions_of_its_environment(tmp_path, monkeypatch):
    monkeypatch.setattr(TrafficJunctionVecEnv, "versions", lambda self: {"map": "junction"}, raising=False)
    assert train_tiny("ppo", tmp_path, "-n", "80") == 0
    flags = ["--env", "mpe/simple_spread_v3", "-n", "80", "-f", str(tmp_path), "--verbose", "0", "--eval-freq", "-1"]
    assert train_main(["--algo", "ppo", *flags, "-params", *TINY["ppo"]]) == 0
    found = {path.parent.name: json.loads(path.read_text())["environment"] for path in tmp_path.rglob("run.json")}
    assert found == {f"{EASY}_1": {"map": "junction"}, "mpe-simple_spread_v3_1": {"mpe2": metadata.version("mpe2")}}


def test_normalize_gives_each_agent_its_own_statistics(tmp_path):
    assert train_tiny("ppo", tmp_path, "-n", "80", "-params", "normalize:{norm_reward: false}") == 0
    team = Team.load(tmp_path / "ppo" / f"{EASY}_1" / "team.zip")
    obs = make_team_env(EASY, n_envs=2, seed=0).reset()
    assert team.normalize == {"norm_reward": False}
    assert set(team.predict(obs)[0]) == set(team.agents)


def test_worker_processes_give_the_same_run(tmp_path):
    returns = []
    for k, vec_env in enumerate(("dummy", "subproc"), start=1):
        flags = ["--env", EASY, "-n", "40", "--seed", "3", "-f", str(tmp_path), "--verbose", "0", "--eval-freq", "-1"]
        settings = ["n_envs:2", "n_steps:20", "batch_size:40"]
        assert train_main(["--algo", "ppo", *flags, "--vec-env", vec_env, "-params", *settings]) == 0
        rows = table(tmp_path / "ppo" / f"{EASY}_{k}" / "monitor.csv", skip=1)
        returns.append([(row["r"], row["is_success"]) for row in rows])
    assert len(returns[0]) == 2 and returns[0] == returns[1]


@pytest.mark.parametrize(
    ("ending", "manner"), [("gif", "--deterministic"), ("gif", "--stochastic"), ("mp4", "--deterministic")]
)
def test_enjoy_writes_an_episode(ending, manner, run, tmp_path, capsys):
    imageio = pytest.importorskip("imageio.v2")
    output = tmp_path / "videos" / f"episode.{ending}"
    assert (
        main(["enjoy", str(run), "--output", str(output), "--episodes", "2", manner, "--env-kwargs", "arrival_rate:0.0"]) == 0
    )
    frames = imageio.mimread(output, memtest=False)
    assert len(frames) == 40 and frames[0].ndim == 3
    said = capsys.readouterr().out
    # no car ever comes: nothing can go wrong
    assert "Mean return over 2 episodes: 0.000" in said and "Success rate: 1.000" in said


def test_enjoy_plays_other_episodes_with_another_seed(run, tmp_path):
    seeds = {"a": "1", "b": "2", "c": "1"}
    for name, seed in seeds.items():
        assert main(["enjoy", str(run), "--output", str(tmp_path / f"{name}.gif"), "--seed", seed]) == 0
    first, second, again = (tmp_path.joinpath(f"{name}.gif").read_bytes() for name in seeds)
    assert first == again and first != second


def test_going_on_meets_other_episodes(run, tmp_path):
    for seed in ("1", "2"):
        words = [
            "train",
            "-i",
            str(run),
            "-n",
            "80",
            "--seed",
            seed,
            "-f",
            str(tmp_path / seed),
            "--eval-freq",
            "-1",
            "--verbose",
            "0",
        ]
        assert main(words) == 0
    first, second = (next(tmp_path.glob(f"{seed}/*/*/monitor.csv")).read_text().splitlines() for seed in ("1", "2"))
    # the same team, so only the traffic can differ; the last columns are a clock and the success
    assert [row.split(",")[0] for row in first[2:]] != [row.split(",")[0] for row in second[2:]]


def test_enjoy_counts_steps_if_asked(run, tmp_path, capsys):
    assert main(["enjoy", str(run / "best_model.zip"), "--output", str(tmp_path / "a.gif"), "-n", "5"]) == 0
    assert "Wrote 5 frames" in capsys.readouterr().out


@pytest.mark.parametrize(("words", "fps"), [([], TrafficJunction.metadata["render_fps"]), (["--fps", "20"], 20)])
def test_enjoy_plays_at_the_pace_of_the_environment_or_as_asked(words, fps, run, tmp_path):
    image = pytest.importorskip("PIL.Image")
    output = tmp_path / "a.gif"
    assert main(["enjoy", str(run), "--output", str(output), *words]) == 0
    # a GIF counts in hundredths of a second
    assert image.open(output).info["duration"] == pytest.approx(1000 / fps, abs=10)


def test_enjoy_opens_a_window(run, monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    assert main(["enjoy", str(run), "-n", "3"]) == 0


def test_an_environment_without_pictures_can_be_trained_and_played(tmp_path, monkeypatch, capsys):
    (tmp_path / "plain_toys.py").write_text("from tests.team.toy_envs import ToyEnv\ndef make():\n    return ToyEnv(2)\n")
    monkeypatch.syspath_prepend(tmp_path)
    allow = ["--allow-package", "plain_toys", "tests"]
    words = ["--env", "plain_toys:make", "-n", "40", "-f", str(tmp_path), "--verbose", "0", "--eval-freq", "-1", *allow]
    assert train_main([*words, "-params", "n_envs:2", "n_steps:10", "batch_size:20"]) == 0
    folder = str(tmp_path / "belief_ppo" / "plain_toys-make_1")
    assert main(["enjoy", folder, "--episodes", "2", *allow]) == 0
    said = capsys.readouterr().out
    assert said.count("7 steps") == 2 and "Nothing is shown: plain_toys:make has no render mode 'human'." in said
    assert main(["enjoy", folder, "--output", str(tmp_path / "a.gif"), *allow]) == 2
    assert "no images" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nowhere"], "enjoy: no file or folder 'nowhere'"),
        (["RUN", "--output", "episode.avi"], "--output: 'episode.avi' must end in .gif or .mp4"),
        (["RUN", "--env-kwargs", "arival_rate:0.1"], "Did you mean 'arrival_rate'"),
        (["stray.zip"], "is not in the folder of a run"),
    ],
)
def test_what_enjoy_refuses(words, message, run, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "stray.zip").touch()
    assert main(["enjoy", *(str(run) if word == "RUN" else word for word in words)]) == 2
    assert message in capsys.readouterr().err
    assert os.listdir(tmp_path) == ["stray.zip"]
