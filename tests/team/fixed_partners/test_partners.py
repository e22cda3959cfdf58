"""Fixed partners: what can be a partner, and that partners and learner do not influence each other."""

import zipfile
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from sb3_contrib import TRPO
from sb3_contrib.common.maskable.evaluation import evaluate_policy as evaluate_masked
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_belief.baselines import IQL
from sb3_belief.belief_ppo import BeliefPPO, MaskableBeliefPPO
from tests.archives import members_of
from tests.team.fixed_partners.helpers import AgentEnv, one, save_exploring_team, toy, zero
from tests.team.helpers import PPO_KWARGS, Team, make_team_env, parameters
from tests.team.toy_envs import MaskedEnv, PartneredEnv, ToyEnv

BELIEF: dict[str, Any] = {
    **PPO_KWARGS,
    "history_length": 16,
    "policy_kwargs": {"net_arch": [8], "embedding_dim": 8, "latent_dim": 4},
}


class Counting:
    """
    Partner with SB3's ``predict`` and a state, which counts the steps of an episode.

    Its action is the number of the step modulo 3. It records each call: step, start of an episode, and ``deterministic``.
    """

    def __init__(self):
        self.calls: list[tuple] = []

    def predict(self, obs, state=None, episode_start=None, deterministic=False):
        t = 0 if state is None or episode_start[0] else state[0] + 1
        self.calls.append((t, bool(episode_start[0]), deterministic))
        return t % 3, (t,)


def trained(path=None, algo=PPO, env=None, **kwargs):
    """Return a team that has learned for 64 timesteps, by default of two agents in a ``ToyEnv``, and save it if asked to."""
    env = make_team_env(toy(2), n_envs=2) if env is None else env
    team = Team(algo, "BeliefPolicy" if algo is BeliefPPO else "MlpPolicy", env, seed=3, **{**PPO_KWARGS, **kwargs})
    team.learn(64)
    if path is not None:
        team.save(path)
    return team


def others_did(env, n_steps=20, seed=0):
    """Return the others' actions that the learner saw, flattened, one row for each step."""
    env.reset(seed=seed)
    seen = []
    for _ in range(n_steps):
        _, _, terminated, truncated, info = env.step(1)
        seen.append(info["others_actions"])
        if terminated or truncated:
            env.reset()
    return np.stack(seen)


def test_all_forms_of_a_model_act_alike(tmp_path):
    team = trained(tmp_path / "team.zip", normalize=True)
    model = team.agents["agent_1"]
    forms = [model, tmp_path / "team.zip", str(tmp_path / "team"), f"{tmp_path / 'team.zip'}:agent_1"]
    expected, *found = [others_did(AgentEnv(toy(2), "agent_0", {"agent_1": form})) for form in forms]
    for did in [*found, others_did(AgentEnv(toy(2), "agent_0", tmp_path / "team.zip"))]:
        assert np.array_equal(did, expected)
    assert len(np.unique(expected, axis=0)) > 1
    # The partner acts as the Team predicts, including normalisation
    env = AgentEnv(toy(2), "agent_0", {"agent_1": model}, deterministic=True)
    did = others_did(env, 6)
    reference = ToyEnv(2)
    obs, _ = reference.reset(seed=0)
    for step in did:
        action = team.predict(obs, deterministic=True)[0]["agent_1"]
        assert step.argmax() == action
        obs = reference.step({"agent_0": 1, "agent_1": action})[0]
    with pytest.raises(ValueError, match=r"a team of \['agent_0', 'agent_1'\], without 'bob'"):
        AgentEnv(toy(2), "agent_0", {"agent_1": f"{tmp_path / 'team.zip'}:bob"})


@pytest.mark.parametrize("algo", [PPO, A2C, TRPO, DQN, BeliefPPO])
def test_zips_of_single_models(tmp_path, algo):
    kwargs: dict[str, Any] = {"policy_kwargs": {"net_arch": [8]}, "device": "cpu"}
    env = make_team_env(toy(2), n_envs=1)
    team = Team(algo, "BeliefPolicy" if algo is BeliefPPO else "MlpPolicy", env, seed=1, **kwargs)
    model = team.agents["agent_1"]
    model.save(tmp_path / "model.zip")
    # What SB3 alone has written has to be unpickled
    trust = algo is not BeliefPPO
    if trust:
        with pytest.raises(ValueError, match="a pickle can run any code of whoever made the file"):
            AgentEnv(toy(2), "agent_0", {"agent_1": tmp_path / "model.zip"})
    expected = others_did(AgentEnv(toy(2), "agent_0", {"agent_1": model}, deterministic=True))
    for path in ("model.zip", "model"):
        env = AgentEnv(toy(2), "agent_0", {"agent_1": tmp_path / path}, deterministic=True, trust_pickle=trust)
        assert np.array_equal(others_did(env), expected)
    # Its zip within the team's has a class and no need of trust
    team.save(tmp_path / "team.zip")
    (tmp_path / "alone.zip").write_bytes(members_of((tmp_path / "team.zip").read_bytes())["agents/agent_1.zip"])
    env = AgentEnv(toy(2), "agent_0", {"agent_1": tmp_path / "alone.zip"}, deterministic=True)
    assert np.array_equal(others_did(env), expected)


def test_files_that_hold_no_partner(tmp_path):
    (tmp_path / "text.zip").write_text("nothing")
    with pytest.raises(ValueError, match="wasn't a zip-file, or it is damaged"):
        AgentEnv(toy(2), "agent_0", {"agent_1": tmp_path / "text.zip"})
    model = PPO("MlpPolicy", gym.make("CartPole-v1"), **PPO_KWARGS)
    model.save(tmp_path / "cartpole.zip")
    with pytest.raises(ValueError, match=r"'agent_1' has been made for the observation space .* but 'agent_1' has"):
        AgentEnv(toy(2), "agent_0", {"agent_1": tmp_path / "cartpole.zip"}, trust_pickle=True)
    with zipfile.ZipFile(tmp_path / "empty.zip", "w") as archive:
        archive.writestr("data", "{}")
    with pytest.raises(ValueError, match="algorithm cannot be told: pass the model itself"):
        AgentEnv(toy(2), "agent_0", {"agent_1": tmp_path / "empty.zip"}, trust_pickle=True)


def test_partners_with_a_state_are_told_of_episodes():
    counting = Counting()
    env = AgentEnv(toy(2), "agent_0", {"agent_1": counting}, deterministic=True)
    others_did(env, 16)
    assert counting.calls == [(t % 7, t % 7 == 0, True) for t in range(16)]


def test_masked_partners_get_their_masks():
    """``MaskedEnv`` raises if an action is masked out."""

    def allowed(obs, action_masks):
        return int(np.flatnonzero(action_masks)[0])

    class Predicts:
        def predict(self, obs, state=None, episode_start=None, deterministic=False, action_masks=None):
            return int(np.flatnonzero(action_masks)[0]), None

    make = partial(MaskedEnv, n_agents=3)
    for partner in (allowed, Predicts()):
        env = AgentEnv(make, "agent_0", {"agent_1": partner, "agent_2": zero})
        env.reset(seed=0)
        for t in range(7):
            assert env.action_masks().dtype == bool and env.action_masks().tolist() == [k == t % 3 for k in range(3)]
            assert env.step(t % 3)[4]["others_actions"][:3].tolist() == [k == (t + 1) % 3 for k in range(3)]
    # The last agent of a MaskedEnv has no mask, so everything is allowed
    unmasked = AgentEnv(make, "agent_2", {"agent_0": allowed, "agent_1": allowed})
    unmasked.reset()
    assert unmasked.action_masks().all()
    bare = AgentEnv(toy(2), "agent_0", {"agent_1": zero})
    bare.reset()
    assert not hasattr(bare, "action_masks")


def test_a_masked_learner_and_a_masked_partner(tmp_path):
    make = partial(MaskedEnv, n_agents=3)
    team = Team(MaskableBeliefPPO, "BeliefPolicy", make_team_env(make), seed=0, **BELIEF)
    team.learn(16)
    team.save(tmp_path / "team.zip")
    env = DummyVecEnv([lambda: AgentEnv(make, "agent_0", tmp_path / "team.zip")] * 2)
    model = MaskableBeliefPPO("BeliefPolicy", env, seed=0, **BELIEF).learn(32)
    assert model.num_timesteps == 32
    # A new environment, whose masks are asked for before its first reset
    env = AgentEnv(make, "agent_0", tmp_path / "team.zip")
    _, lengths = evaluate_masked(model, env, n_eval_episodes=2, return_episode_rewards=True, warn=False)
    assert lengths == [7, 7]


def test_it_takes_the_place_of_a_team_for_one_learner(tmp_path):
    trained(tmp_path / "team.zip", algo=BeliefPPO, **{k: v for k, v in BELIEF.items() if k not in PPO_KWARGS})
    env = AgentEnv(toy(2), "agent_0", tmp_path / "team.zip")
    model = BeliefPPO("BeliefPolicy", env, seed=0, **BELIEF).learn(40)
    assert list(model.others_action_spaces) == ["agent_1"] and "belief/action_loss" in model.logger.name_to_value
    assert model.policy.history is not None and len(model.policy.history.observations) == 16
    model.save(tmp_path / "learner")
    again = BeliefPPO.load(tmp_path / "learner", env=env)
    assert np.isfinite(evaluate_policy(again, env, n_eval_episodes=2, warn=False)[0])


@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, SubprocVecEnv])
def test_partners_are_swapped_during_training(tmp_path, vec_env_cls):
    trained(tmp_path / "team.zip")
    env = make_vec_env(
        AgentEnv,
        n_envs=2,
        seed=0,
        env_kwargs={"parallel_env": toy(2), "agent": "agent_0", "partners": {"agent_1": str(tmp_path / "team.zip")}},
        vec_env_cls=vec_env_cls,
    )
    model = BeliefPPO("BeliefPolicy", env, seed=0, **BELIEF).learn(32)
    for partner, expected in ((zero, 0), (one, 1)):
        env.env_method("set_partner", "agent_1", partner)
        for _ in range(3):
            infos = env.step(np.zeros(2, int))[3]
            assert [info["others_actions"].argmax() for info in infos] == [expected] * 2
    model.learn(32, reset_num_timesteps=False)
    assert model.num_timesteps == 64
    env.close()


def test_the_learner_does_not_depend_on_its_partners_random_numbers():
    """The agents of a ``ToyEnv`` do not influence each other, so the learner learns the same with any partner."""

    def noisy(obs):
        return np.random.randint(3)

    results = []
    for partner in (noisy, zero, PPO("MlpPolicy", AgentEnv(toy(1), "agent_0", {}), **PPO_KWARGS)):
        env = AgentEnv(toy(2), "agent_0", {"agent_1": partner})
        model = PPO("MlpPolicy", env, seed=0, **PPO_KWARGS)
        model.learn(8)
        env.set_partner("agent_1", partner)
        results.append(parameters(model.learn(24, reset_num_timesteps=False)))
    assert all((result == results[0]).all() for result in results)


@pytest.mark.parametrize("algo", [PPO, DQN, IQL])
def test_seeded_partners_sample_the_same_again(algo, tmp_path):
    if algo is PPO:
        trained(tmp_path / "team.zip")
    else:
        save_exploring_team(tmp_path / "team.zip", algo, n_agents=2)
    env = AgentEnv(toy(2), "agent_0", tmp_path / "team.zip")
    first, second, other = (others_did(env, seed=seed) for seed in (4, 4, 5))
    assert np.array_equal(first, second) and not np.array_equal(first, other)


def test_normalised_models_keep_their_statistics():
    env = VecNormalize(DummyVecEnv([lambda: AgentEnv(toy(1), "agent_0", {})]))
    model = PPO("MlpPolicy", env, seed=0, **PPO_KWARGS).learn(64)
    seen: list[np.ndarray] = []
    predict = model.predict
    model.predict = lambda obs, *args, **kwargs: (seen.append(obs), predict(obs, *args, **kwargs))[1]  # type: ignore
    joint = AgentEnv(toy(2), "agent_0", {"agent_1": model})
    joint.reset(seed=0)
    raw = joint.parallel_env.observations()["agent_1"]
    joint.step(0)
    assert np.array_equal(seen[0], np.asarray(env.normalize_obs(raw))) and not np.allclose(seen[0], raw)


def test_scripted_others_come_after_the_partners():
    env = AgentEnv(PartneredEnv, "arrow", {"ball": lambda obs: np.array([0.5], np.float32)})
    assert list(env.others_action_spaces) == ["ball", "wind", "leader"]
    env.reset(seed=0)
    assert env.step(0)[4]["others_actions"].tolist() == [0.5, 1, -1, 1, 0, 0, 0]
