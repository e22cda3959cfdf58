"""Environments that say ``is_success`` at some ends only: each end has it, so that SB3's EvalCallback can save evaluations."""

import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env

from sb3_belief import AgentEnv, envs
from tests.field.walkers import Walkers, play
from tests.team.helpers import PPO_KWARGS, Team, make_team_env


class Sometimes(Walkers):
    """Says it at every third end only."""

    ends = 0

    def change(self, *parts):
        if not self.agents:
            self.ends += 1
            if self.ends % 3 == 0:
                parts[4]["walker_0"]["is_success"] = True
        return parts


class FromElsewhere(Walkers):
    """Says by its attribute that it does, since its code does not show it."""

    reports_success: bool | None = True
    ends = 0

    def change(self, *parts):
        if not self.agents:
            self.ends += 1
            if self.ends % 3 == 0:
                parts[4]["walker_0"]["_".join(("is", "success"))] = True
        return parts


class Late(FromElsewhere):
    """Neither says so nor shows it."""

    reports_success = None


def successes(env, n_episodes):
    return [infos[0].get("is_success") for *_, dones, infos in play(env, 4 * n_episodes) if dones[0]]


@pytest.mark.parametrize("kind", [Sometimes, FromElsewhere])
@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_each_end_has_it(kind, vec_env):
    env = make_team_env(kind, vec_env=vec_env)
    assert successes(env, 6) == [False, False, True] * 2
    env.close()


def test_a_wrapper_may_say_it():
    from pettingzoo.utils.wrappers import BaseParallelWrapper

    class Judge(BaseParallelWrapper):
        def step(self, actions):
            *parts, infos = super().step(actions)
            return *parts, {agent: dict(is_success=True) if not self.env.agents else {} for agent in infos}

    assert successes(make_team_env(Walkers, wrapper=Judge), 2) == [True, True]
    assert make_team_env(Walkers, wrapper=Judge).reports_success


def test_none_where_the_environment_knows_no_success():
    assert successes(make_team_env(Walkers), 3) == [None] * 3


def test_from_the_first_time_on_where_it_could_not_be_known():
    assert successes(make_team_env(Late), 6) == [None, None, True, False, False, True]


def test_an_environment_that_does_not_say_so_is_believed():
    class Mute(Sometimes):
        reports_success = False

        def change(self, *parts):
            return parts

    assert successes(make_team_env(Mute), 2) == [None] * 2


def test_evaluations_of_a_team_are_saved(tmp_path):
    env = make_team_env(Sometimes, n_envs=2)
    callback = EvalCallback(make_team_env(Sometimes), eval_freq=8, n_eval_episodes=2, log_path=str(tmp_path), verbose=0)
    Team(PPO, "MlpPolicy", env, seed=0, **PPO_KWARGS).learn(64, callback=callback)
    saved = np.load(tmp_path / "evaluations.npz")["successes"]
    assert saved.tolist() == [[False, False], [True, False], [False, True], [False, False]]


@pytest.mark.parametrize("kind", [Sometimes, "traffic-junction-easy"])
def test_evaluations_of_a_single_learner_are_saved(tmp_path, kind):
    """In the junction, a learner's life mostly ends before the team's episode."""
    others = ["walker_1"] if kind is Sometimes else [f"car_{i}" for i in range(1, 5)]
    agent = "walker_0" if kind is Sometimes else "car_0"
    kwargs = {"parallel_env": kind, "agent": agent, "partners": dict.fromkeys(others, lambda obs: 0)}
    env, eval_env = (make_vec_env(AgentEnv, n_envs=n, seed=0, env_kwargs=kwargs) for n in (2, 1))
    callback = EvalCallback(eval_env, eval_freq=40, n_eval_episodes=5, log_path=str(tmp_path), verbose=0)
    PPO("MlpPolicy", env, seed=0, **{**PPO_KWARGS, "n_steps": 40, "batch_size": 40}).learn(240, callback=callback)
    assert np.load(tmp_path / "evaluations.npz")["successes"].shape == (3, 5)


def test_the_checker_asks_for_it():
    text = str(envs.check_team_env(Sometimes, n_steps=40))
    assert "note  success: is_success at 3 of 10 ends only" in text and "return it at each end" in text
