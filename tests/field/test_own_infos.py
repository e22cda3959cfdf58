"""What an environment's infos say besides reaches the team's infos and the agents', and replaces none of ours."""

import csv
from contextlib import nullcontext

import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecMonitor

from sb3_belief import AgentEnv, BeliefPPO
from sb3_belief.vec_env.own_infos import RESERVED
from tests.field.walkers import Walkers, play
from tests.team.helpers import PPO_KWARGS, Team, make_team_env


class Fuel(Walkers):
    """Each agent says how much fuel it has (a number), where it is (an array that is reused) and a word."""

    def __init__(self):
        super().__init__()
        self.where = np.zeros(2)

    def change(self, obs, rewards, terminations, truncations, infos):
        self.where += 1
        for i, agent in enumerate(infos):
            infos[agent] = {"fuel": self.t + i, "where": self.where, "word": f"word {i}", "active": True}
        return obs, rewards, terminations, truncations, infos


@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_the_teams_infos(vec_env):
    env = make_team_env(Fuel, n_envs=2, vec_env=vec_env)
    steps = [infos[1] for *_, infos in play(env, 5)]
    env.close()
    assert [info["fuel"] for info in steps] == [1.5, 2.5, 3.5, 4.5, 1.5]
    assert steps[1]["agent_infos"]["walker_1"]["fuel"] == 3 and steps[1]["word"] == "word 0"
    # Copies: the environment writes into its array at each step
    assert [info["where"].tolist() for info in steps] == [[t, t] for t in range(1, 6)]
    assert set(steps[0]["agent_infos"]["walker_0"]) == {"fuel", "where", "word"}


def test_without_own_infos_there_are_none():
    assert all("agent_infos" not in infos[0] for *_, infos in play(make_team_env(Walkers), 4))


class Greedy(Walkers):
    """Says something under each key that means something in the infos of a team or of an agent, and of the game as a whole."""

    def change(self, obs, rewards, terminations, truncations, infos):
        taken = dict.fromkeys(RESERVED - {"action_mask", "active", "life_end", "is_success"}, "taken")
        infos = {agent: {**taken, "mine": agent} for agent in infos}
        return obs, rewards, terminations, truncations, {**infos, "score": 3, "visible": "taken"}


def test_ours_are_not_replaced():
    usual = play(make_team_env(Walkers), 4)
    for (*_, [info]), (*_, [info_]) in zip(play(make_team_env(Greedy), 4), usual, strict=True):
        assert info.keys() == info_.keys() | {"agent_infos", "mine", "score"}
        assert "taken" not in map(str, info.values()) and info["score"] == 3
        assert info["agent_infos"] == {agent: {"mine": agent} for agent in ("walker_0", "walker_1")}


class See(BaseCallback):
    """Keeps the infos of the first copy."""

    def _on_training_start(self):
        self.infos = []

    def _on_step(self):
        self.infos.append(self.locals["infos"][0])
        return True


@pytest.mark.parametrize("jobs", [1, 2])
def test_callbacks_of_the_team_and_of_an_agent_see_them(jobs):
    of_team, of_agent = See(), See()
    team = Team(BeliefPPO, "BeliefPolicy", make_team_env(Fuel, n_envs=2), seed=0, jobs=jobs, **PPO_KWARGS)
    # A callback of one's own brings all agents into this process, with a warning
    with pytest.warns(UserWarning) if jobs > 1 else nullcontext():
        team.learn(16, callback=of_team, agent_callbacks={"walker_1": of_agent})
    assert [info["fuel"] for info in of_team.infos[:5]] == [1.5, 2.5, 3.5, 4.5, 1.5]
    assert [info["fuel"] for info in of_agent.infos[:5]] == [2, 3, 4, 5, 2]
    assert of_agent.infos[0]["word"] == "word 1" and of_agent.infos[0]["active"] is True


def test_an_agent_that_learns_in_another_process_gets_them():
    team = Team(PPO, "MlpPolicy", make_team_env(Fuel), seed=0, jobs=2, **PPO_KWARGS)
    seen = See()
    team.learn(16, agent_callbacks={"walker_0": seen})
    assert [info["fuel"] for info in seen.infos[:4]] == [1, 2, 3, 4]


@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_a_monitor_writes_them(tmp_path, vec_env):
    env = VecMonitor(make_team_env(Fuel, n_envs=2, vec_env=vec_env), str(tmp_path / "team"), info_keywords=("fuel", "word"))
    Team(PPO, "MlpPolicy", env, seed=0, **PPO_KWARGS).learn(16)
    env.close()
    with open(tmp_path / "team.monitor.csv") as file:
        next(file)
        rows = list(csv.DictReader(file))
    assert len(rows) == 4 and all((row["fuel"], row["word"]) == ("4.5", "word 0") for row in rows)


def test_a_single_learner_gets_them(tmp_path):
    env = Monitor(AgentEnv(Fuel, "walker_1", {"walker_0": lambda obs: 0}), str(tmp_path / "own"), info_keywords=("fuel",))
    env.reset(seed=0)
    infos = [env.step(1)[4] for _ in range(4)]
    assert [info["fuel"] for info in infos] == [2, 3, 4, 5] and infos[3]["episode"]["fuel"] == 5
