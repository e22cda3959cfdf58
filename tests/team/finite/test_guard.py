"""What is looked at around an update, and what is put back, tensor by tensor."""

from functools import partial
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch as th
from stable_baselines3 import A2C, DQN, PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback

from sb3_belief import BeliefPPO
from sb3_belief.team import NonFiniteError
from sb3_belief.team.finite import UpdateGuard
from tests.team.finite.agents import ALGORITHMS, OddEnv, Watch, contents, is_finite, make_team, same, spoil
from tests.team.helpers import PPO_KWARGS, Team, make_team_env


@pytest.mark.parametrize("on_nan", ["raise", "skip"])
@pytest.mark.parametrize("algo", ALGORITHMS)
def test_a_healthy_training_is_the_same_without_the_checks(algo, on_nan):
    teams = [make_team(algo, on_nan) for _ in range(2)]
    watches = [{"agent_0": Watch()} for _ in teams]
    teams[0].learn(96, agent_callbacks=watches[0])
    with mock.patch.object(UpdateGuard, "arm", lambda self: None):
        teams[1].learn(96, agent_callbacks=watches[1])
    for agent in ("agent_0", "agent_1"):
        one, other = (team.agents[agent] for team in teams)
        assert one._n_updates == other._n_updates > 0
        assert same(contents(one), contents(other))
        assert not same(contents(one), contents(make_team(algo).agents[agent]))
        assert one.logger.name_to_value.keys() == other.logger.name_to_value.keys()
        assert not hasattr(one, "skipped_updates")
    for one, other in zip(watches[0]["agent_0"].starts, watches[1]["agent_0"].starts, strict=True):
        assert same(one, other)


class Constant(PPO):
    """PPO that logs a value, as SB3 logs the explained variance of returns that are all equal."""

    key = "train/explained_variance"

    def train(self):
        super().train()
        self.logger.record(self.key, np.nan)


class Other(Constant):
    """The same of another key."""

    key = "train/my_loss"


def test_an_explained_variance_may_be_nan_and_a_loss_may_not():
    env = partial(make_team_env, OddEnv, n_envs=1)
    Team(Constant, "MlpPolicy", env(), seed=0, **PPO_KWARGS).learn(32)
    team = Team(Other, "MlpPolicy", env(), seed=0, **PPO_KWARGS)
    with pytest.raises(NonFiniteError, match=r"train/my_loss is nan.*Likely cause: none of the usual ones") as caught:
        team.learn(32)
    assert caught.value.key == "train/my_loss"


# Faults

FAULTS: dict[str, tuple[dict[str, Any], dict[str, Any], str]] = {
    "reward": ({"at": 20, "reward": 1e38}, {}, r"rewards in its (rollout|replay buffer) reach 1e\+38"),
    "learning rate": ({}, {"learning_rate": 1e30}, r"learning_rate is 1e\+30"),
}


# The gradient of DQN's loss does not grow with the rewards
@pytest.mark.parametrize(
    "algo, fault", [(a, f) for a in (PPO, BeliefPPO, DQN, SAC) for f in FAULTS if (a, f) != (DQN, "reward")]
)
def test_a_fault_is_found_named_and_taken_back(algo, fault, tmp_path):
    env_kwargs, own, cause = FAULTS[fault]
    team = make_team(algo, env_kwargs=env_kwargs, agent_kwargs={"agent_1": own})
    watch = Watch()
    with pytest.raises(FloatingPointError, match=cause) as caught:
        team.learn(400, agent_callbacks={"agent_1": watch})
    error = caught.value
    assert isinstance(error, NonFiniteError) and error.agent == "agent_1"
    model = team.agents["agent_1"]
    assert f"joint step {model.num_timesteps}" in str(error) and error.num_timesteps == model.num_timesteps
    assert error.key and error.key in str(error) and error.n_updates >= 0
    assert all(is_finite(each) for each in team.agents.values())
    if algo in (PPO, BeliefPPO):
        assert same(contents(model), watch.ends[-1])
    else:
        assert any(same(contents(model), each) for each in watch.ends[-40:])
    assert "train" not in vars(model)
    team.save(tmp_path / "team")
    loaded = Team.load(tmp_path / "team", allow_packages=["tests"])
    assert same(contents(loaded.agents["agent_1"]), contents(model))


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_a_weight_that_is_spoilt_within_an_update(algo):
    team = make_team(algo)
    model, watch = team.agents["agent_1"], Watch()
    spoil(model, at_step=6)
    with pytest.raises(NonFiniteError) as caught:
        team.learn(200, agent_callbacks={"agent_1": watch})
    assert is_finite(model)
    if algo in (PPO, BeliefPPO, A2C):
        assert same(contents(model), watch.ends[-1])
    else:
        # Found in this update or the next, since it makes no forward pass in between
        assert caught.value.n_updates in (6, 7)
        assert any(same(contents(model), each) for each in watch.ends)
    if algo is A2C:
        assert caught.value.n_updates == 6 and caught.value.key.startswith("policy.")
        assert "1 of 16 values are not finite" in str(caught.value)


def test_moments_of_an_optimizer_are_looked_at_too():
    team = make_team(DQN)
    model = team.agents["agent_0"]

    def hook(optimizer, *_):
        if model._n_updates == 40:
            first = optimizer.param_groups[0]["params"][0]
            optimizer.state[first]["exp_avg_sq"].fill_(np.inf)

    model.policy.optimizer.register_step_post_hook(hook)
    with pytest.raises(NonFiniteError, match=r"before its update .* policy.optimizer: exp_avg_sq of policy.q_net") as caught:
        team.learn(200)
    # At the next update for which all is copied
    assert caught.value.n_updates == 64 and model._n_updates == 32
    assert is_finite(model)


def test_an_error_of_the_users_own_stays_as_it_is():
    team = make_team()
    model = team.agents["agent_0"]

    def fail(*_):
        raise ValueError("by hand")

    model.policy.optimizer.register_step_post_hook(fail)
    with pytest.raises(ValueError, match="by hand") as caught:
        team.learn(32)
    assert type(caught.value) is ValueError and str(caught.value) == "by hand"
    assert "train" not in vars(model)


def test_a_train_of_the_models_own_is_called_and_stays():
    team, calls = make_team(), []
    model = team.agents["agent_0"]
    own = vars(model)["train"] = lambda: calls.append(1)
    team.learn(32)
    assert len(calls) == 4 and vars(model)["train"] is own


def test_a_team_that_is_not_finite_from_the_beginning_does_not_learn():
    for on_nan in ("raise", "skip"):
        team = make_team(on_nan=on_nan)
        with th.no_grad():
            team.agents["agent_1"].policy.value_net.bias.fill_(np.inf)
        with pytest.raises(NonFiniteError, match=r"policy.value_net.bias.*before it began to learn"):
            team.learn(32)


def test_a_critic_is_not_taken_for_rewards():
    """SB3 adds its values to the rewards where a time limit ends an episode."""
    team = make_team()
    with th.no_grad():
        team.agents["agent_1"].policy.value_net.weight.fill_(1e25)
    with pytest.raises(NonFiniteError, match=r"policy.value_net.weight had reached 1e\+25 before: lower learning_rate"):
        team.learn(32)


class Enlarge(BaseCallback):
    """Callback of an agent that makes a layer so large at its second rollout that actions cannot be drawn any more."""

    model: Any

    def _on_step(self):
        if self.n_calls == 9:
            with th.no_grad():
                self.model.policy.action_net.weight.copy_(th.tensor([[3e38, -3e38] * 4] * 3))
        return True


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_the_cause_of_an_error_in_a_rollout_is_a_note():
    with pytest.raises(ValueError, match="found invalid values") as caught:
        make_team().learn(32, agent_callbacks={"agent_1": Enlarge()})
    assert "Likely cause: the steps of its optimizer are too large" in " ".join(caught.value.__notes__)
    assert "policy.action_net.weight had reached 3e+38" in " ".join(caught.value.__notes__)


def test_standard_deviations_may_be_the_cause():
    team = make_team(SAC, env_kwargs={}, ent_coef="auto")
    model = team.agents["agent_1"]
    with th.no_grad():
        model.log_ent_coef.fill_(95.0)
    with pytest.raises(NonFiniteError, match=r"log_ent_coef reach 9[0-9].*set it to a number"):
        team.learn(100)
