"""An update that makes a model non-finite is found at once, taken back, and not saved."""

import json
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DQN, PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger

from sb3_belief import BeliefPPO
from sb3_belief.cli.main import train_main
from sb3_belief.team import NonFiniteError
from tests.team.helpers import PPO_KWARGS, Team, make_team_env, parameters
from tests.team.toy_envs import ToyEnv

OFF = {"learning_starts": 8, "batch_size": 8, "buffer_size": 100, "device": "cpu", "policy_kwargs": {"net_arch": [8]}}


class Rewards(ToyEnv):
    """Environment whose rewards to agent_0 become too large for a float32's square, from a step on."""

    def __init__(self, start=60):
        super().__init__(2)
        self.start, self.n_steps = start, 0

    def step(self, actions):
        obs, rewards, *rest = super().step(actions)
        self.n_steps += 1
        if self.n_steps >= self.start:
            rewards["agent_0"] = 1e30
        return obs, rewards, *rest


def pushes():
    from mpe2 import simple_spread_v3

    return simple_spread_v3.parallel_env(continuous_actions=True, max_cycles=7)


ALGOS: dict[str, tuple[Any, str, Any, dict[str, Any]]] = {
    "ppo": (PPO, "MlpPolicy", ToyEnv, PPO_KWARGS),
    "belief": (BeliefPPO, "BeliefPolicy", ToyEnv, {**PPO_KWARGS, "history_length": 20}),
    "dqn": (DQN, "MlpPolicy", ToyEnv, OFF),
    "sac": (SAC, "MlpPolicy", pushes, OFF),
}


def make(name, **kwargs):
    algo, policy, env_id, settings = ALGOS[name]
    env = make_team_env(kwargs.pop("env_id", env_id), n_envs=1, seed=0)
    return Team(algo, policy, env, seed=0, **{**settings, **kwargs})


class Spoil(BaseCallback):
    """
    Callback of a team that has agent_0's update write nan into a weight, once.

    :param at: The joint step at or after which it does so
    """

    model: Any

    def __init__(self, at):
        super().__init__()
        self.at, self.before = at, th.zeros(0)

    def _on_rollout_end(self):
        model = self.model.agents["agent_0"]
        if self.model.num_timesteps >= self.at and not self.before.numel():
            self.before = parameters(model)
            handle: Any = None

            def spoil(optimizer, args, kwargs):
                handle.remove()
                with th.no_grad():
                    optimizer.param_groups[0]["params"][-1].view(-1)[0] = float("nan")

            optimizer = getattr(model.policy, "optimizer", None) or model.critic.optimizer
            handle = optimizer.register_step_post_hook(spoil)

    def _on_step(self):
        return True


@pytest.mark.parametrize("name", ALGOS)
def test_it_is_found_at_once_and_taken_back(name, tmp_path):
    team, callback = make(name), Spoil(40)
    first = next(iter(team.agents))
    assert first == "agent_0"
    with pytest.raises(NonFiniteError, match=r"Agent 'agent_0': loss or parameters are not finite .*Likely cause: ") as caught:
        team.learn(200, callback)
    error, model = caught.value, team.agents["agent_0"]
    assert error.agent == "agent_0" and error.key and error.cause and str(error.num_timesteps) in str(error)
    # An off-policy algorithm updates at each step, and keeps what it was at most 32 updates ago
    assert 40 <= error.num_timesteps <= 40 + (8 if name in ("ppo", "belief") else 33)
    if name in ("ppo", "belief"):
        assert th.equal(parameters(model), callback.before)
    for agent in team.agents.values():
        assert th.isfinite(parameters(agent)).all()
    team.save(tmp_path / "team.zip")
    assert th.equal(parameters(Team.load(tmp_path / "team.zip").agents["agent_0"]), parameters(model))


@pytest.mark.parametrize("name", ALGOS)
def test_skipped_it_goes_on(name):
    team, callback = make(name, on_nan="skip"), Spoil(40)
    with pytest.warns(RuntimeWarning, match="agent_0.*are not finite"):
        team.learn(120, callback)
    assert team.num_timesteps >= 120
    model = team.agents["agent_0"]
    assert th.isfinite(parameters(model)).all() and not th.equal(parameters(model), callback.before)
    assert team.logger.name_to_value.get("train/skipped_updates", 1) == 1


def test_the_cause_is_said():
    with pytest.raises(NonFiniteError, match="the rewards in its rollout reach 1e\\+30: scale them down"):
        make("ppo", env_id=Rewards).learn(200)
    with pytest.raises(NonFiniteError, match=r"learning_rate is 1e\+30"):
        make("dqn", learning_rate=1e30).learn(200)


def test_an_agent_in_another_process(tmp_path):
    """agent_0 is the one that learns in the worker."""
    team = Team(PPO, "MlpPolicy", make_team_env(Rewards, n_envs=1, seed=0), seed=0, jobs=2, **PPO_KWARGS)
    with pytest.raises(NonFiniteError, match=r"Agent 'agent_0'.*rewards in its rollout reach") as caught:
        team.learn(200)
    assert caught.value.agent == "agent_0"
    assert all(th.isfinite(parameters(model)).all() for model in team.agents.values())
    # As in one process, all but the traceback
    alone = Team(PPO, "MlpPolicy", make_team_env(Rewards, n_envs=1, seed=0), seed=0, **PPO_KWARGS)
    with pytest.raises(NonFiniteError) as here:
        alone.learn(200)
    assert str(here.value) == str(caught.value)
    # The other agent learns at the same time there, and would have been next here
    assert th.equal(parameters(alone.agents["agent_0"]), parameters(team.agents["agent_0"]))


def test_nothing_non_finite_is_saved(tmp_path):
    team = make("dqn").learn(20)
    with th.no_grad():
        next(team.agents["agent_1"].policy.parameters()).view(-1)[0] = float("inf")
    with pytest.raises(ValueError, match=r"not saved, because agent 'agent_1' .*1 of \d+ values are not finite"):
        team.save(tmp_path / "team.zip")
    assert not (tmp_path / "team.zip").exists()


@pytest.mark.parametrize("name", ALGOS)
def test_a_healthy_training_is_the_same_either_way(name):
    taken = [make(name, on_nan=on_nan).learn(80) for on_nan in ("raise", "skip")]
    for agent, model in taken[0].agents.items():
        assert th.equal(parameters(model), parameters(taken[1].agents[agent]))
        assert "train" not in vars(model)


def test_a_nan_that_is_no_fault():
    """The variance of returns that are all equal is zero, and what is explained of it not a number."""

    class NoReward(ToyEnv):
        def step(self, actions):
            obs, rewards, *rest = super().step(actions)
            return obs, dict.fromkeys(rewards, 0.0), *rest

    team = make("ppo", env_id=NoReward, gamma=0.0)
    seen = []

    class Look(KVWriter):
        def write(self, key_values, key_excluded, step=0):
            seen.append(key_values.get("train/explained_variance", 0.0))

        def close(self):
            pass

    team.agents["agent_0"].set_logger(Logger(None, [Look()]))
    team.learn(40)
    assert team.num_timesteps == 40 and np.isnan(seen[-1])


def test_words_that_are_neither():
    for wrong in ("stop", None, True):
        with pytest.raises(ValueError, match=r"must be 'raise' .* or 'skip'"):
            make("ppo", on_nan=wrong)


def test_the_flag(tmp_path):
    settings = ["n_envs:2", "n_steps:20", "batch_size:40", "n_epochs:1", "learning_rate:1e30"]
    flags = ["--algo", "ppo", "--env", "traffic-junction-easy", "-n", "200", "--seed", "0", "--eval-freq", "-1"]
    flags += ["--verbose", "0"]
    for on_nan, status, says in (("raise", 1, "failed"), ("skip", 0, "finished")):
        words = [*flags, "-f", str(tmp_path / on_nan), "--on-nan", on_nan, "-params", *settings]
        with np.errstate(all="ignore"):
            assert train_main(words) == status
        record = json.loads(next(tmp_path.glob(f"{on_nan}/*/*/run.json")).read_text())
        assert record["status"] == says and record["options"]["on_nan"] == on_nan
        folder = next(tmp_path.glob(f"{on_nan}/*/*/team.zip"))
        assert all(th.isfinite(parameters(model)).all() for model in Team.load(folder).agents.values())
