"""Normalisation: of agents that are out of play at times, of partners that were trained with it, and where it is saved."""

import pickle
import warnings
import zipfile
from functools import partial

import numpy as np
import pytest
from gymnasium import spaces
from pettingzoo import ParallelEnv
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import CheckpointCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_belief import AgentEnv
from sb3_belief.team.normalization import AgentNormalize
from tests.team.helpers import PPO_KWARGS, Team, make_team_env, parameters
from tests.team.toy_envs import ToyEnv, ToySolo


class Shifts(ParallelEnv):
    """
    ``early`` leaves after 3 of 8 steps, ``late`` is listed but inactive until step 4, ``always`` is always there. Who is in
    play observes [5, 10 + step] and earns 1, who is not observes ``filler``.
    """

    metadata = {"name": "shifts"}  # noqa: RUF012
    render_mode = None

    def __init__(self, filler=0.0):
        self.possible_agents, self.agents, self.filler = ["early", "late", "always"], [], filler

    def observation_space(self, agent):
        return spaces.Box(-100, 100, (2,), np.float32)

    def action_space(self, agent):
        return spaces.Discrete(2)

    def look(self, agent):
        values = [self.filler] * 2 if agent == "late" and self.t < 4 else [5, 10 + self.t]
        return np.array(values, np.float32)

    def reset(self, seed=None, options=None):
        self.t, self.agents = 0, list(self.possible_agents)
        return {agent: self.look(agent) for agent in self.agents}, {agent: {} for agent in self.agents}

    def step(self, actions):
        acted, inactive = self.agents, {"late"} if self.t < 4 else set()
        self.t += 1
        over = {agent: self.t == 8 or (agent == "early" and self.t == 3) for agent in acted}
        self.agents = [agent for agent in acted if not over[agent]]
        obs = {agent: self.look(agent) for agent in self.agents or acted}
        infos = {agent: {"active": agent not in inactive} for agent in acted}
        rewards = {agent: float(agent not in inactive) for agent in acted}
        return obs, rewards, over, dict.fromkeys(acted, False), infos


@pytest.mark.parametrize("jobs", [1, 2])
def test_steps_out_of_play_do_not_count(jobs):
    env = make_team_env(Shifts, n_envs=2)
    team = Team(PPO, "MlpPolicy", env, seed=0, normalize=True, jobs=jobs, **PPO_KWARGS)
    team.learn(2 * 16 * 8)
    statistics = {agent: model.get_vec_normalize_env() for agent, model in team.agents.items()}
    early, late, always = (statistics[agent].obs_rms for agent in team.possible_agents)
    # Of an episode "early" sees the steps 0 to 2, "always" 0 to 7; "late" the first one, which may be one, and 5 to 7
    assert early.count == pytest.approx(2 * 16 * 3 + 2, abs=0.01) and always.count == pytest.approx(2 * 16 * 8 + 2, abs=0.01)
    assert early.mean == pytest.approx([5, 11], abs=0.05) and early.var[0] == pytest.approx(0, abs=1e-2)
    assert always.mean == pytest.approx([5, 13.5], abs=0.05)
    assert late.count == pytest.approx(2 * 16 * 4 + 2, abs=0.01)
    # The returns of 1, 2, 3 (undiscounted: almost) of "early" are not pulled down by zeros
    assert statistics["early"].ret_rms.mean == pytest.approx(np.mean([1, 1.99, 2.9701]), abs=0.01)
    assert statistics["late"].ret_rms.mean == pytest.approx(np.mean([1, 1.99, 2.9701, 3.9404]), abs=0.01)


def test_what_the_environment_gives_the_inactive_does_not_count():
    team = Team(PPO, "MlpPolicy", make_team_env(partial(Shifts, 50.0)), seed=0, normalize=True, **PPO_KWARGS)
    team.learn(16)
    rms = team.agents["late"].get_vec_normalize_env().obs_rms
    # At a reset it is not known who is in play; three resets, and the steps 5 to 7 of two episodes
    assert rms.mean[0] == pytest.approx((3 * 50 + 6 * 5) / 9, abs=0.01)


def test_who_is_always_in_play_is_normalised_as_by_sb3():
    kwargs = {**PPO_KWARGS, "seed": 3}
    team = Team(PPO, "MlpPolicy", make_team_env(partial(ToyEnv, n_agents=1), n_envs=2), normalize=True, **kwargs)
    own = VecNormalize(make_vec_env(ToySolo, n_envs=2, seed=3))
    alone = PPO("MlpPolicy", own, **{**kwargs, "seed": team.agents["agent_0"].seed})
    team.get_env().seed(11)
    own.seed(11)
    team.learn(64)
    alone.learn(64)
    theirs = team.agents["agent_0"].get_vec_normalize_env()
    assert isinstance(theirs, AgentNormalize) and not isinstance(own, AgentNormalize)
    for name in ("mean", "var", "count"):
        assert np.array_equal(getattr(theirs.obs_rms, name), getattr(own.obs_rms, name))
        assert np.array_equal(getattr(theirs.ret_rms, name), getattr(own.ret_rms, name))
    assert np.array_equal(parameters(team.agents["agent_0"]), parameters(alone))


def test_saved_statistics_are_sb3s_and_come_back(tmp_path):
    team = Team(PPO, "MlpPolicy", make_team_env(Shifts), seed=0, normalize=True, **PPO_KWARGS).learn(16)
    team.save(tmp_path / "team")
    with zipfile.ZipFile(tmp_path / "team.zip") as archive:
        content = archive.read("agents/late.vecnormalize.pkl")
    assert type(pickle.loads(content)) is VecNormalize and b"sb3_belief" not in content
    loaded = Team.load(tmp_path / "team", env=make_team_env(Shifts))
    statistics = loaded.agents["late"].get_vec_normalize_env()
    assert isinstance(statistics, AgentNormalize) and vars(statistics)["obs_rms"].count > 1
    # Also those of a team that can only predict
    Team.load(tmp_path / "team").save(tmp_path / "again")
    Team.load(tmp_path / "again", env=make_team_env(Shifts)).learn(16)


def test_a_checkpoint_says_where_the_statistics_are(tmp_path):
    callback = CheckpointCallback(8, str(tmp_path), save_vecnormalize=True)
    with pytest.warns(UserWarning, match="each agent's statistics are in the team's zip"):
        Team(PPO, "MlpPolicy", make_team_env(Shifts), seed=0, normalize=True, **PPO_KWARGS).learn(8, callback)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Team(PPO, "MlpPolicy", make_team_env(Shifts), seed=0, **PPO_KWARGS).learn(8, callback)


# Partners


@pytest.fixture
def trained(tmp_path):
    """A model that has learned in VecNormalize, saved with its statistics as SB3's CheckpointCallback names them."""
    env = VecNormalize(make_vec_env(partial(AgentEnv, partial(ToyEnv, n_agents=1), "agent_0", {})))
    model = PPO("MlpPolicy", env, seed=0, **PPO_KWARGS).learn(64)
    model.save(tmp_path / "rl_model_64_steps")
    env.save(str(tmp_path / "rl_model_vecnormalize_64_steps.pkl"))
    return model, env, tmp_path


def acts_on(monkeypatch, partner):
    """Return what a partner's model is given, and the environment's observation behind it."""
    seen, predict = [], PPO.predict

    def noted(self, obs, *args):
        seen.append(obs)
        return predict(self, obs, *args)

    monkeypatch.setattr(PPO, "predict", noted)
    # The files are SB3's own, so they have to be unpickled
    env = AgentEnv(ToyEnv, "agent_0", {"agent_1": partner}, trust_pickle=True)
    env.reset(seed=0)
    raw = env.parallel_env.observations()["agent_1"]
    env.step(0)
    return seen[0], raw


def test_a_partner_takes_its_statistics(trained, monkeypatch):
    _, env, folder = trained
    path, file = folder / "rl_model_64_steps", folder / "rl_model_vecnormalize_64_steps.pkl"
    loaded = PPO.load(path)
    for partner in ((path, file), (str(path), str(file)), (loaded, file), (path, env), (loaded, env)):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            seen, raw = acts_on(monkeypatch, partner)
        assert np.array_equal(seen, env.normalize_obs(raw)) and not np.allclose(seen, raw)
    seen, raw = acts_on(monkeypatch, (path, None))
    assert np.array_equal(seen, raw)


@pytest.mark.parametrize("name", ["rl_model_vecnormalize_64_steps.pkl", "vecnormalize.pkl"])
def test_statistics_beside_a_zip_are_asked_for(trained, monkeypatch, name):
    model, _, folder = trained
    (folder / "rl_model_vecnormalize_64_steps.pkl").rename(folder / name)
    with pytest.warns(
        UserWarning, match=rf"acts on observations as they are.*as the pair \(.*{name}'\); if not, as .*, None\)"
    ):
        seen, raw = acts_on(monkeypatch, folder / "rl_model_64_steps")
    assert np.array_equal(seen, raw)
    (folder / name).unlink()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        acts_on(monkeypatch, folder / "rl_model_64_steps")
        acts_on(monkeypatch, model)


def test_statistics_that_are_none_are_refused(trained, tmp_path):
    model, _, folder = trained
    (tmp_path / "text").write_text("hello")
    for wrong, says in ((3, "must be a VecNormalize, the path"), (tmp_path / "text", "must be a VecNormalize, the path")):
        with pytest.raises(TypeError, match=says):
            AgentEnv(ToyEnv, "agent_0", {"agent_1": (model, wrong)}, trust_pickle=True)
    with pytest.raises(ValueError, match=r"have to be unpickled, and a pickle can run any code .* VecNormalize\.load\(\)"):
        AgentEnv(ToyEnv, "agent_0", {"agent_1": (model, tmp_path / "text")})
    with pytest.raises(FileNotFoundError):
        AgentEnv(ToyEnv, "agent_0", {"agent_1": (model, folder / "nothing.pkl")})
    other = VecNormalize(make_vec_env("CartPole-v1"))
    with pytest.raises(ValueError, match="statistics of the partner 'agent_1' are of the observation space"):
        AgentEnv(ToyEnv, "agent_0", {"agent_1": (model, other)})
