"""SB3 wrappers of a user's own around a team: what they change reaches the agents, or is refused at once."""

from typing import Any

import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnvWrapper, VecMonitor

from tests.team.helpers import PPO_KWARGS, Team, make_team_env, parameters
from tests.team.toy_envs import ScriptedEnv, ToyEnv


class Wrapper(VecEnvWrapper):
    """Changes nothing."""

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        return self.change(*self.venv.step_wait())

    def change(self, obs, rewards, dones, infos):
        return obs, rewards, dones, infos


class Scale(Wrapper):
    def change(self, obs, rewards, dones, infos):
        return obs, 100 * rewards, dones, infos


class ScaleInPlace(Wrapper):
    def change(self, obs, rewards, dones, infos):
        rewards *= 100
        return obs, rewards, dones, infos


class BonusAtTheEnd(Wrapper):
    def change(self, obs, rewards, dones, infos):
        return obs, rewards + np.where(dones, 1.0, 0.0), dones, infos


class ScaleForAll(Wrapper):
    """Changes the agents' own rewards, too."""

    def change(self, obs, rewards, dones, infos):
        for info in infos:
            info["agent_rewards"] = 100 * info["agent_rewards"]
        return obs, 100 * rewards, dones, infos


class RepeatActions(Wrapper):
    def step_wait(self):
        total = np.zeros(self.num_envs)
        for _ in range(2):
            self.venv.step_async(self.actions)
            obs, rewards, dones, infos = self.venv.step_wait()
            total = total + rewards
        return obs, total, dones, infos

    def step_async(self, actions):
        self.actions = actions


class EndEarly(Wrapper):
    def change(self, obs, rewards, dones, infos):
        return obs, rewards, dones | (np.asarray(obs["agent_0"])[:, 0] > -np.inf), infos


class FlipActions(Wrapper):
    def step_async(self, actions):
        flipped: Any = {agent: 2 - chosen for agent, chosen in actions.items()}
        self.venv.step_async(flipped)


class AsFloat64(Wrapper):
    def change(self, obs, rewards, dones, infos):
        return {agent: 2 * part for agent, part in obs.items()}, rewards.astype(np.float64), dones.copy(), infos


def learn(wrap, env=ToyEnv, **kwargs):
    team = Team(PPO, "MlpPolicy", wrap(make_team_env(env, n_envs=2, seed=0)), seed=0, **PPO_KWARGS)
    return team.learn(32, **kwargs)


@pytest.mark.parametrize("wrap", [Scale, ScaleInPlace, BonusAtTheEnd, RepeatActions, lambda env: VecMonitor(Scale(env))])
def test_changed_rewards_are_refused(wrap):
    with pytest.raises(
        ValueError, match=r"changes the team's rewards, from which no agent learns.*wrapper of the ParallelEnv"
    ):
        learn(wrap)


def test_the_wrapper_is_named_and_so_is_the_step():
    with pytest.raises(ValueError, match="The wrapper Scale changes") as caught:
        learn(lambda env: VecMonitor(Scale(env)))
    assert "joint step 1 of this learn()" in "".join(getattr(caught.value, "__notes__", []))


def test_changed_ends_are_refused():
    with pytest.raises(ValueError, match="EndEarly changes when episodes end"):
        learn(EndEarly)


def test_rewards_that_are_changed_for_all_reach_the_agents():
    plain, scaled = learn(Wrapper), learn(ScaleForAll)
    for agent, model in scaled.agents.items():
        own = plain.agents[agent].rollout_buffer.rewards
        # What both did in the first rollout is equal; the last one is compared by its size only
        assert np.abs(model.rollout_buffer.rewards).mean() > 20 * np.abs(own).mean()


@pytest.mark.parametrize(
    "wrap", [Wrapper, VecMonitor, FlipActions, AsFloat64, lambda env: FlipActions(VecMonitor(Wrapper(env)))]
)
def test_harmless_wrappers_are_not_refused(wrap):
    team = learn(wrap)
    assert team.num_timesteps == 32 and all(np.abs(m.rollout_buffer.rewards).max() > 0 for m in team.agents.values())


def test_a_wrapper_that_changes_nothing_changes_nothing():
    wrapped, plain = learn(lambda env: VecMonitor(Wrapper(env)), ScriptedEnv), learn(lambda env: env, ScriptedEnv)
    for agent, model in plain.agents.items():
        assert np.array_equal(parameters(model), parameters(wrapped.agents[agent]))
