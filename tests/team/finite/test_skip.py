"""Training that goes on without updates that are not finite, also in workers; and what is not saved."""

import csv
import warnings
from functools import partial

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DQN, PPO, SAC

from sb3_belief import BeliefPPO
from sb3_belief.team import NonFiniteError
from tests.team.finite.agents import ALGORITHMS, OddEnv, Watch, contents, is_finite, make_team, same, spoil
from tests.team.helpers import Team, make_team_env


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_skip_takes_the_update_back_and_goes_on(algo):
    team = make_team(algo, "skip")
    model, watch = team.agents["agent_1"], Watch()
    spoil(model, at_step=6)
    with pytest.warns(RuntimeWarning, match=r"'agent_1'.*taken back; further ones are counted") as caught:
        team.learn(96, agent_callbacks={"agent_1": watch})
    assert len([w for w in caught if "taken back" in str(w.message)]) == 1
    assert model.skipped_updates == 1 and not hasattr(team.agents["agent_0"], "skipped_updates")
    assert team.num_timesteps == 96 and is_finite(model)
    # Just one update has changed nothing, and learning went on after it
    updates = [i for i in range(len(watch.ends)) if i + 1 < len(watch.starts) and i >= (10 if algo in (DQN, SAC) else 0)]
    unchanged = [i for i in updates if same(watch.starts[i + 1], watch.ends[i])]
    assert len(unchanged) == 1 and unchanged[0] < updates[-1]
    # Only that agent's training differs
    undisturbed = make_team(algo).learn(96, agent_callbacks={"agent_1": Watch()})
    assert same(contents(undisturbed.agents["agent_0"]), contents(team.agents["agent_0"]))
    assert not same(contents(undisturbed.agents["agent_1"]), contents(model))


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_skipped_updates_are_counted_in_the_table(tmp_path):
    team = make_team(on_nan="skip", agent_kwargs={"agent_0": {"learning_rate": 1e30}}, log_dir=str(tmp_path))
    spoil(team.agents["agent_1"], at_step=3)
    team.learn(40)
    skipped = [team.agents[agent].skipped_updates for agent in ("agent_0", "agent_1")]
    assert skipped == [5, 1]
    with open(tmp_path / "progress.csv") as file:
        rows = [row["train/skipped_updates"] for row in csv.DictReader(file)]
    # A table shows the update before it
    assert rows == ["", "1", "3", "4", "5"]


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_reward_in_a_replay_buffer_does_not_end_learning():
    team = make_team(SAC, "skip", env_kwargs={"at": 20, "reward": 1e38}).learn(200)
    model = team.agents["agent_1"]
    assert model.skipped_updates > 1 and is_finite(model)
    # 190 updates were tried
    assert model._n_updates == 190 - model.skipped_updates > 0


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("on_nan", ["raise", "skip"])
def test_statistics_of_an_agent_become_finite_again(on_nan, tmp_path):
    team = make_team(on_nan=on_nan, env_kwargs={"at": 12, "observation": 1e30}, n_envs=2, normalize=True)
    # In one copy only: their variance is more than a float32 holds
    team.get_env().set_attr("at", 0, indices=1)
    if on_nan == "raise":
        with pytest.raises(
            NonFiniteError, match=r"before its update.*obs_rms.var of its normalisation.*too large for running"
        ):
            team.learn(64)
    else:
        team.learn(64)
        assert team.agents["agent_1"].skipped_updates == 1 and team.num_timesteps == 64
    statistics = team.agents["agent_1"].get_vec_normalize_env()
    assert np.isfinite(statistics.obs_rms.var).all() and statistics.obs_rms.count > 16
    team.save(tmp_path / "team")


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_statistics_become_finite_again_after_an_error_in_a_rollout(tmp_path):
    team = make_team(env_kwargs={"at": 12, "observation": 3e38}, n_envs=2, normalize=True)
    with pytest.raises(ValueError, match="found invalid values") as caught:
        team.learn(64)
    assert "too large for running statistics" in " ".join(caught.value.__notes__)
    # 8 steps of both copies, and the reset
    assert team.agents["agent_1"].get_vec_normalize_env().obs_rms.count == pytest.approx(18, abs=1)
    team.save(tmp_path / "team")


# With jobs, and in files


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("algo", [PPO, BeliefPPO])
def test_workers_find_the_same(algo, tmp_path):
    found = []
    for jobs in (1, 2):
        # agent_0 learns in the worker
        team = make_team(algo, jobs=jobs, agent_kwargs={"agent_0": {"learning_rate": 1e30}})
        with pytest.raises(NonFiniteError, match=r"learning_rate is 1e.30") as caught:
            team.learn(64)
        team.save(tmp_path / "team")
        error = caught.value
        found.append((str(error), error.agent, error.n_updates, error.num_timesteps, error.key, error.cause, team))
    assert found[0][:-1] == found[1][:-1]
    # In this process agent_1 is behind agent_0 in the order of the team
    assert same(*(contents(each[-1].agents["agent_0"]) for each in found))


def test_workers_skip_the_same(tmp_path):
    tables, teams, warned = [], [], []
    for jobs in (1, 2):
        folder = tmp_path / str(jobs)
        team = make_team(jobs=jobs, on_nan="skip", agent_kwargs={"agent_0": {"learning_rate": 1e30}}, log_dir=str(folder))
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            team.learn(64)
        warned.append([str(w.message) for w in caught if "taken back" in str(w.message)])
        with open(folder / "progress.csv") as file:
            tables.append([{k: v for k, v in row.items() if not k.startswith("time/")} for row in csv.DictReader(file)])
        teams.append(team)
    assert len(warned[0]) == 1 and warned[0] == warned[1]
    assert tables[0] == tables[1] and tables[0][-1]["train/skipped_updates"] == "7"
    assert [team.agents["agent_0"].skipped_updates for team in teams] == [8, 8]
    assert all(same(*(contents(team.agents[agent]) for team in teams)) for agent in ("agent_0", "agent_1"))


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_training_that_goes_on_exactly_goes_on_counting(tmp_path):
    def begin():
        team = make_team(SAC, "skip", env_kwargs={"at": 20, "reward": 1e38})
        return team.learn(60)

    whole = begin().learn(60, reset_num_timesteps=False)
    begin().save(tmp_path / "team", exact=True)
    env = make_team_env(partial(OddEnv, at=20, reward=1e38, box=True), n_envs=1)
    team = Team.load(tmp_path / "team", env=env, exact=True, on_nan="skip", allow_packages=["tests"])
    team.learn(60, reset_num_timesteps=False)
    model, other = team.agents["agent_1"], whole.agents["agent_1"]
    assert model.skipped_updates == other.skipped_updates > 1
    assert same(contents(model), contents(other))


@pytest.mark.parametrize("algo", [PPO, DQN])
def test_nothing_that_is_not_finite_is_saved(algo, tmp_path):
    team = make_team(algo, normalize=True).learn(32)
    path = tmp_path / "team.zip"
    team.save(path)
    before = path.read_bytes()
    parameter = next(iter(team.agents["agent_1"].policy.parameters()))
    kept = parameter.detach().clone()
    parameter.data[0] = np.nan
    with pytest.raises(ValueError, match=r"agent 'agent_1'.*policy.*weight: 2 of 16 values are not finite"):
        team.save(path)
    parameter.data.copy_(kept)
    moment = team.agents["agent_0"].policy.optimizer.state_dict()["state"][1]["exp_avg"]
    moment[0] = np.inf
    with pytest.raises(ValueError, match=r"agent 'agent_0'.*policy.optimizer: exp_avg of policy.*bias"):
        team.save(path)
    moment[0] = 0.0
    statistics = team.agents["agent_1"].get_vec_normalize_env()
    mean = statistics.obs_rms.mean.copy()
    statistics.obs_rms.mean[1] = np.nan
    with pytest.raises(ValueError, match=r"agent 'agent_1'.*obs_rms.mean of its normalisation"):
        team.save(path)
    assert path.read_bytes() == before
    statistics.obs_rms.mean = mean
    team.save(path)


def test_a_mask_of_a_network_may_be_infinite(tmp_path):
    team = make_team()
    policy = team.agents["agent_0"].policy
    policy.register_buffer("mask", th.tensor([0.0, -np.inf]))
    team.learn(32).save(tmp_path / "team")
    policy.mask[0] = np.nan
    with pytest.raises(ValueError, match=r"policy.mask"):
        team.save(tmp_path / "team")


def test_on_nan_is_one_of_two(tmp_path):
    for wrong in ("ignore", None, True):
        with pytest.raises(ValueError, match=f"on_nan is {wrong!r}; it must be 'raise'.*'skip'"):
            make_team(on_nan=wrong)
    team = make_team()
    assert team.on_nan == "raise"
    team.save(tmp_path / "team")
    with pytest.raises(ValueError, match="on_nan is 'ignore'"):
        Team.load(tmp_path / "team", on_nan="ignore")
    assert Team.load(tmp_path / "team", on_nan="skip").on_nan == "skip"
