"""Joint learners by name: trained, evaluated, resumed, shown, and told apart from decentralised ones."""

import io
import json

import numpy as np
import pytest
import torch as th

from sb3_belief.cli.main import main
from sb3_belief.references.factorisation import ValueFactorisation
from sb3_belief.references.joint_vec_env import joint_team
from sb3_belief.zoo.config import load_config
from tests.references.counting_team import CountingTeam
from tests.team.exact.test_exact import SaveOnce
from tests.team.helpers import Team, make_team_env

NAMES = ("vdn", "qmix", "qplex", "qtran", "coma", "maddpg", "rode")


@pytest.mark.parametrize("name", NAMES)
def test_every_name_says_that_it_uses_the_state(name):
    config = load_config(name, "two-step")
    assert config.note == "uses the global state in training"
    assert config.algo_kwargs.get("mixer", name) == name


def test_train_py_trains_evaluates_resumes_and_shows_it(tmp_path, capsys):
    words = ["--algo", "qmix", "--env", "traffic-junction-easy", "--seed", "1", "-f", str(tmp_path)]
    words += ["-n", "320", "--eval-freq", "160", "--eval-episodes", "2", "--save-freq", "160"]
    assert main(["train", *words, "-params", "n_envs:2", "batch_size:2"]) == 0
    run = tmp_path / "qmix" / "traffic-junction-easy_1"
    assert json.loads((run / "run.json").read_text())["note"] == "uses the global state in training"
    assert "qmix uses the global state in training" in capsys.readouterr().out
    with np.load(run / "evaluations.npz") as evaluations:
        assert evaluations["timesteps"].tolist() == [160, 320]
    assert main(["train", "--resume", str(run), "--until", "400"]) == 0
    assert json.loads((run / "run.json").read_text())["timesteps"] == 400
    assert main(["enjoy", str(run), "--episodes", "1", "--output", str(tmp_path / "a.gif")]) == 0
    assert "Episode 1" in capsys.readouterr().out


@pytest.mark.parametrize("recurrent", [True, False])
def test_a_resumed_training_is_the_undisturbed_one(recurrent):
    def make_env():
        return joint_team(make_team_env(CountingTeam, n_envs=2, seed=0))

    arguments = {"batch_size": 2, "buffer_size": 5, "policy_kwargs": {"recurrent": recurrent, "hidden_dim": 8}}
    whole, callback = Team(ValueFactorisation, "FactorisedPolicy", make_env(), seed=0, **arguments), SaveOnce(at=32)
    whole.learn(96, callback=callback)
    resumed = Team.load(io.BytesIO(callback.saved), env=make_env(), exact=True)
    resumed.learn(96 - resumed.num_timesteps, callback=SaveOnce(), reset_num_timesteps=False)
    ours, theirs = (
        th.cat([p.detach().flatten() for p in team.agents["team"].policy.parameters()]) for team in (whole, resumed)
    )
    assert th.equal(ours, theirs)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["mpe/simple_spread_v3", "--env-kwargs", "continuous_actions:True"], "needs agents with Discrete actions"),
        (["two-step", "-params", "normalize:True"], "does not take normalised observations"),
        (["two-step", "-params", "td_lambda:2.0"], "td_lambda=2.0 must be a number in [0, 1]"),
    ],
)
def test_what_they_do_not_take_is_refused_before_anything_is_written(words, message, tmp_path, capsys):
    assert main(["train", "--algo", "qmix", "-n", "10", "-f", str(tmp_path), "--env", *words]) != 0
    assert message in capsys.readouterr().err
    assert not any(path.is_file() for path in tmp_path.rglob("*"))
