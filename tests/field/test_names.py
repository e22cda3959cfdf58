"""Names of agents as users give them: no text, or text that cannot be part of a path."""

import os
import zipfile
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import PPO

from sb3_belief import AgentEnv, BeliefPPO, MaskableBeliefPPO
from sb3_belief.common.file_names import file_name
from tests.archives import archive_of, changed_json, members_of
from tests.field.walkers import Walkers, play
from tests.team.helpers import PPO_KWARGS, Team, make_team_env


class Named(Walkers):
    """
    Knows its agents by any names, and checks that it is spoken to by these.

    :param names: The names
    """

    def __init__(self, names):
        super().__init__()
        self.possible_agents = list(names)
        self.scripted_action_spaces = {("wind", 1): spaces.Discrete(2)}

    def observation_space(self, agent):
        assert agent in self.possible_agents
        return self.obs_space

    def reset(self, seed=None, options=None):
        obs, infos = super().reset()
        return self.change(obs, {}, {}, {}, infos)[::4]

    def step(self, actions):
        assert list(actions) == self.agents
        return super().step(actions)

    def change(self, obs, rewards, terminations, truncations, infos):
        masks = {agent: {"action_mask": np.array([1, 0, 1]), "number": 7} for agent in infos}
        return obs, rewards, terminations, truncations, masks

    def visibility(self):
        return {agent: [agent == self.possible_agents[0], self.t > 1] for agent in self.possible_agents}

    def team_reward(self, rewards):
        return rewards[self.possible_agents[1]]

    def scripted_actions(self):
        return {("wind", 1): self.t % 2}


NUMBERS, TUPLES, MIXED = [3, 1], [("red", 0), ("red", 1)], [None, "walker"]


@pytest.mark.parametrize("names", [NUMBERS, TUPLES, MIXED])
@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_names_that_are_no_text(names, vec_env):
    first, second = map(str, names)
    env = make_team_env(Named, env_kwargs={"names": names}, n_envs=2, vec_env=vec_env)
    assert env.possible_agents == [first, second] and list(env.scripted_action_spaces) == ["('wind', 1)"]
    steps = play(env, 4)
    obs, rewards, _, infos = steps[1]
    assert obs[second].tolist() == [[2, 1, 0]] * 2 and rewards.tolist() == [2, 2]
    assert infos[0]["agent_rewards"].tolist() == [1, 2] and infos[0]["visible"].tolist() == [[True, True], [False, True]]
    assert infos[0]["agent_infos"] == {first: {"number": 7}, second: {"number": 7}}
    assert env.action_masks()[second].tolist() == [[True, False, True]] * 2
    assert steps[3][2].all() and list(steps[3][3][1]["terminal_observation"]) == [first, second]
    env.close()


def test_the_user_says_who_sees_whom_by_the_own_names():
    class Blind(Walkers):
        def __init__(self):
            super().__init__()
            self.possible_agents = [0, 1]

    env = make_team_env(Blind, visibility=lambda env: {0: [True], 1: [env.t > 1]})
    assert [infos[0]["visible"].tolist() for *_, infos in play(env, 2)] == [[[True], [False]], [[True], [True]]]


def test_a_single_learner_and_its_partners():
    env: Any = AgentEnv(lambda: Named(NUMBERS), 3, {1: lambda obs: 0})  # type: ignore[arg-type, dict-item]
    env.reset(seed=0)
    assert env.agent == "3" and env.step(1)[4]["others_visible"].tolist() == [True, False]
    env.set_partner(1, lambda obs: 2)
    env.step(0)
    assert env.parallel_env.actions == {3: 0, 1: 2}


def test_two_names_with_one_text():
    with pytest.raises(ValueError, match=r"Two agents of \[1, '1'\] have the same name as text"):
        make_team_env(Named, env_kwargs={"names": [1, "1"]})


LONG = "x" * 300
HOSTILE = ["../../up", "..", "/etc/passwd", "a/b", "a\0b", "", ".", LONG, LONG + "y", "C:\\x", "%", "%2E", "ä b", "\udc80"]


def test_each_name_has_a_file_of_its_own(tmp_path):
    files = [file_name(name) for name in HOSTILE]
    assert len(set(files)) == len(files)
    for file in files:
        path = tmp_path / f"{file}.vecnormalize.pkl"
        path.touch()
        assert path.resolve().parent == tmp_path.resolve()
    assert file_name("ä b") == "ä b" and file_name("adversary_0") == "adversary_0" and file_name("a.b") == "a.b"


def written(folder):
    """All files under a folder."""
    return {os.path.relpath(os.path.join(root, file), folder) for root, _, files in os.walk(folder) for file in files}


@pytest.mark.parametrize("names", [NUMBERS, TUPLES, *([name, "walker"] for name in HOSTILE)], ids=ascii)
def test_logs_monitors_and_saved_teams_stay_in_their_folder(tmp_path, names):
    inner = tmp_path / "a" / "b" / "c"
    env = make_team_env(Named, env_kwargs={"names": names}, n_envs=2, seed=0)
    env.start_monitor(str(inner / "run"))
    kwargs = {"seed": 0, "log_dir": str(inner / "run"), "normalize": True, **PPO_KWARGS}
    team = Team(MaskableBeliefPPO, "BeliefPolicy", env, **kwargs).learn(16)
    team.save(inner / "run" / "team.zip")
    found = written(tmp_path)
    assert len(found) == 7 and all(file.startswith(os.path.join("a", "b", "c", "run")) for file in found)
    with zipfile.ZipFile(inner / "run" / "team.zip") as archive:
        assert all(len(file.split("/")) <= 2 and ".." not in file for file in archive.namelist())
    loaded = Team.load(inner / "run" / "team.zip", env=env)
    assert list(loaded.agents) == [str(name) for name in names]
    obs = env.reset()
    actions, actions_ = (each.predict(obs, deterministic=True)[0] for each in (team, loaded))
    assert all(np.array_equal(actions[agent], actions_[agent]) for agent in actions)


def test_tensorboard_logs_stay_in_their_folder(tmp_path):
    env = make_team_env(Named, env_kwargs={"names": ["../../up", "/tmp/field"]})
    Team(PPO, "MlpPolicy", env, seed=0, tensorboard_log=str(tmp_path / "a" / "b"), **PPO_KWARGS).learn(8)
    assert {file.split(os.sep)[:2] == ["a", "b"] for file in written(tmp_path)} == {True}
    assert not os.path.exists("/tmp/field")


def test_a_saved_partner_whose_name_has_a_colon(tmp_path):
    env = make_team_env(Named, env_kwargs={"names": ["a:1", "b"]}, seed=0)
    team = Team(BeliefPPO, "BeliefPolicy", env, seed=0, **PPO_KWARGS)
    team.save(tmp_path / "team.zip")
    learner = AgentEnv(lambda: Named(["a:1", "b"]), "b", {"a:1": f"{tmp_path / 'team.zip'}:a:1"}, deterministic=True)
    learner.reset(seed=0)
    learner.step(0)
    expected = team.agents["a:1"].predict(np.zeros(3, np.float32), deterministic=True)[0]
    assert learner.parallel_env.actions["a:1"] == expected


def test_files_with_names_as_they_were(tmp_path):
    """Earlier versions wrote names as they are."""
    env = make_team_env(Named, env_kwargs={"names": ["a:1", "b"]}, seed=0)
    team = Team(BeliefPPO, "BeliefPolicy", env, seed=0, normalize=True, **PPO_KWARGS)
    team.save(tmp_path / "team.zip")
    members = members_of((tmp_path / "team.zip").read_bytes())
    assert "agents/a%3A1.zip" in members
    members["team.json"] = changed_json(format=1)(members["team.json"])
    old = {name.replace("%3A", ":"): each for name, each in members.items() if name.endswith((".zip", ".pkl", "team.json"))}
    (tmp_path / "old.zip").write_bytes(archive_of(old))
    loaded = Team.load(tmp_path / "old.zip", env=env, trust_pickle=True)
    assert list(loaded.agents) == ["a:1", "b"] == list(loaded._agents.statistics)
