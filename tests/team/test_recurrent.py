"""A recurrent memory that lasts over the episodes with one partner, and returns that end with the episodes nonetheless."""

import io
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch as th
from sb3_contrib import RecurrentPPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_belief.team import AgentEnv, ObserveLast, PartnerRecurrentPPO
from tests.team.guest_env import GuestEnv, trained_guest
from tests.team.helpers import Team, make_team_env, parameters

SETTINGS: dict[str, Any] = {
    "n_steps": 16,
    "batch_size": 40,
    "n_epochs": 2,
    "device": "cpu",
    "policy_kwargs": {"net_arch": [8], "lstm_hidden_size": 8},
}


def guests(n_envs=4, **kwargs):
    return make_team_env(GuestEnv, n_envs=n_envs, seed=0, observe_last=True, partner_starts=True, **kwargs)


def partner_team(env=None, **kwargs):
    return Team(PartnerRecurrentPPO, "MlpLstmPolicy", env or guests(), seed=0, **{**SETTINGS, **kwargs})


class AtRolloutEnd(BaseCallback):
    """Callback that calls a function with the guest's model and the rollout's steps before the model trains on them."""

    model: Any

    def __init__(self, function):
        super().__init__()
        self.function = function
        self.steps: list[Any] = []

    def _on_step(self):
        self.steps.append((self.locals["rewards"].copy(), self.locals["dones"].copy(), list(self.locals["infos"])))
        return True

    def _on_rollout_end(self):
        self.function(self.model.agents["guest"], *zip(*self.steps, strict=True))
        self.steps.clear()


def test_training_sees_the_states_of_the_rollout_and_the_first_ratio_is_one(monkeypatch):
    ratios: list[th.Tensor] = []
    cut: list[tuple] = []
    continued: list[np.ndarray] = []

    def check(policy, data):
        with th.no_grad():
            _, log_prob, _ = policy.evaluate_actions(
                data.observations, data.actions.long().flatten(), data.lstm_states, data.episode_starts
            )
        mask = data.mask > 1e-8
        ratios.append(th.exp(log_prob - data.old_log_prob)[mask])

    def train(self):
        buffer: Any = self.rollout_buffer
        starts, states = buffer.observations["memory_start"][..., 0], buffer.hidden_states_pi[:, 0].copy()
        ends = buffer.episode_starts.copy()
        # A rollout is replayed step by step from the state that it began with
        policy, hidden = self.policy, tuple(th.as_tensor(part[0]) for part in (buffer.hidden_states_pi, buffer.cell_states_pi))
        for t in range(buffer.buffer_size):
            np.testing.assert_allclose(hidden[0][0], states[t], atol=1e-6)
            obs = {key: th.as_tensor(part[t]) for key, part in buffer.observations.items()}
            with th.no_grad():
                _, hidden = policy.get_distribution(obs, hidden, th.zeros(4))
        continued.append(states[(ends == 1) & (starts == 0)])
        original(self)
        cut.append((buffer.episode_starts.flatten().sum(), starts.sum()))

    original = PartnerRecurrentPPO.train
    monkeypatch.setattr(PartnerRecurrentPPO, "train", train)
    stock = RecurrentPPO.train

    def before_updates(self):
        np.random.seed(7)
        for data in self.rollout_buffer.get(self.batch_size):
            check(self.policy, data)
        stock(self)

    monkeypatch.setattr(RecurrentPPO, "train", before_updates)
    partner_team().learn(3 * 64)
    assert len(cut) == 3 and all(sequences == starts > 0 for sequences, starts in cut)
    np.testing.assert_allclose(th.cat(ratios).numpy(), 1, atol=1e-5)
    # Episodes that began with a memory of those before
    assert all(len(rows) and rows.any(axis=1).all() for rows in continued[1:])


def test_returns_end_with_episodes_and_are_bootstrapped_at_limits():
    checked = []

    def check(model, rewards, dones, infos):
        buffer, rewards, dones = model.rollout_buffer, np.array(rewards), np.array(dones)
        np.testing.assert_array_equal(buffer.episode_starts[1:], dones[:-1])
        np.testing.assert_array_equal(buffer.rewards[~dones], rewards[~dones])
        # All copies end together, by truncation: the value of the last observation, with the memory that there is then
        for t in np.flatnonzero(dones[:-1, 0]).tolist():
            last = [info["terminal_observation"]["guest"] for info in infos[t]]
            obs = {key: th.as_tensor(np.stack([row[key] for row in last])) for key in last[0]}
            memory = tuple(th.as_tensor(states[t + 1]) for states in (buffer.hidden_states_vf, buffer.cell_states_vf))
            with th.no_grad():
                values = model.policy.predict_values(obs, memory, th.zeros(4)).numpy()[:, 0]
            np.testing.assert_allclose(buffer.rewards[t], rewards[t] + model.gamma * values, atol=1e-5)
        # GAE by hand, from the true ends
        expected = buffer.advantages[-1]
        for t in reversed(range(len(dones) - 1)):
            delta = buffer.rewards[t] + model.gamma * buffer.values[t + 1] * ~dones[t] - buffer.values[t]
            expected = delta + model.gamma * model.gae_lambda * ~dones[t] * expected
            np.testing.assert_allclose(buffer.advantages[t], expected, atol=1e-5)
        checked.append(dones.sum())

    partner_team().learn(2 * 64, callback=AtRolloutEnd(check))
    assert checked == [32, 32]


def test_only_a_memory_over_episodes_knows_the_host():
    """Each host stays for two episodes. The second gives no clue: that of the first has to be remembered."""
    success = {}
    for algo in (PartnerRecurrentPPO, RecurrentPPO):
        env = make_team_env(partial(GuestEnv, every=2), n_envs=20, seed=1000, partner_starts=True)
        mean: Any = evaluate_policy(trained_guest(algo), env, n_eval_episodes=160)[0]
        success[algo.__name__] = mean / 2
    assert success["PartnerRecurrentPPO"] > 0.95
    # At the most: all of the first episodes, and a guess in the second ones
    assert success["RecurrentPPO"] < 0.86


def test_a_saved_team_acts_and_goes_on_alike():
    team = partner_team()
    team.learn(128)
    file = io.BytesIO()
    team.save(file, exact=True)
    team.learn(128, reset_num_timesteps=False)
    file.seek(0)
    other = Team.load(file, env=guests(), device="cpu", exact=True)
    other.learn(128, reset_num_timesteps=False)
    assert type(other.agents["guest"]) is PartnerRecurrentPPO
    assert th.equal(parameters(team.agents["guest"]), parameters(other.agents["guest"]))


def test_beside_a_fixed_partner_it_learns_what_it_learns_in_a_team():
    """ObserveLast around an AgentEnv is what make_team_env adds for a team of one."""
    env = make_vec_env(
        AgentEnv,
        n_envs=4,
        seed=3,
        wrapper_class=ObserveLast,
        wrapper_kwargs={"partner_starts": True},
        env_kwargs={"parallel_env": GuestEnv, "agent": "guest", "partners": {}},
    )
    team_env = make_team_env(GuestEnv, n_envs=4, seed=3, observe_last=True, partner_starts=True)
    assert env.observation_space == team_env.observation_space["guest"]
    obs, team_obs = env.reset(), team_env.reset()["guest"]
    rng = np.random.default_rng(0)
    for _ in range(60):
        assert all(obs[key].tobytes() == team_obs[key].tobytes() for key in team_obs)
        actions = rng.integers(2, size=4)
        obs, rewards, dones, infos = env.step(actions)
        team_obs, team_rewards, team_dones, team_infos = team_env.step({"guest": actions})
        team_obs = team_obs["guest"]
        np.testing.assert_array_equal(rewards, team_rewards)
        np.testing.assert_array_equal(dones, team_dones)
        for info, team_info in zip(infos, team_infos, strict=True):
            if "terminal_observation" in info:
                mine, theirs = info["terminal_observation"], team_info["terminal_observation"]["guest"]
                assert all(mine[key].tobytes() == theirs[key].tobytes() for key in theirs)
    PartnerRecurrentPPO("MlpLstmPolicy", env, **SETTINGS).learn(64)


def test_refused():
    with pytest.raises(ValueError, match=r"'memory_start'.*partner_starts=True"):
        Team(PartnerRecurrentPPO, "MlpLstmPolicy", make_team_env(GuestEnv), **SETTINGS)
    with pytest.raises(ValueError, match="derived from PartnerMemoryPolicy"):
        policy = RecurrentPPO.policy_aliases["MultiInputLstmPolicy"]
        Team(PartnerRecurrentPPO, policy, guests(), **SETTINGS)
