"""Partners in a team: they act as in an ``AgentEnv``, for all copies at once, and the learners get the same."""

from typing import Any, cast

import numpy as np
import pytest
from sb3_contrib import MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from sb3_belief import BeliefPPO
from sb3_belief.team import PartnerPool, PartnersVecEnv, batched
from sb3_belief.team.agent_models import agent_seed, env_seed
from tests.team.fixed_partners.helpers import AgentEnv, one, toy, zero
from tests.team.helpers import PPO_KWARGS, Team, make_team_env, parameters
from tests.team.partners.helpers import BELIEF, noisy, partnered, play, saved_team
from tests.team.toy_envs import MaskedEnv, MixedEnv, PartneredEnv, ScriptedEnv, ToyEnv

EASY = "traffic-junction-easy"
CARS = ["car_1", "car_2", "car_3", "car_4"]


def brakes_at_random(obs):
    return np.random.randint(2)


@pytest.fixture(scope="module")
def easy_team(tmp_path_factory):
    path = tmp_path_factory.mktemp("teams") / "team.zip"
    Team(PPO, "MlpPolicy", make_team_env(EASY), seed=0, **PPO_KWARGS).learn(16).save(path)
    return str(path)


@pytest.mark.parametrize("algo, policy, kwargs", [(PPO, "MlpPolicy", PPO_KWARGS), (BeliefPPO, "BeliefPolicy", BELIEF)])
@pytest.mark.parametrize("partner", ["callables", "saved team"])
def test_a_learner_learns_what_it_learns_in_an_agent_env(algo, policy, kwargs, partner, easy_team):
    """To the bit, also with partners that sample."""
    partners = dict.fromkeys(CARS, brakes_at_random if partner == "callables" else easy_team)
    team = Team(algo, policy, make_team_env(EASY), seed=3, partners=partners, **kwargs).learn(64)
    env = DummyVecEnv([lambda: AgentEnv(EASY, "car_0", partners)])
    model = algo(policy, env, seed=agent_seed(3, 0), **kwargs)
    model.get_env().seed(env_seed(3))
    model.learn(64)
    assert np.array_equal(parameters(team.agents["car_0"]), parameters(model))
    assert list(team.agents) == ["car_0"]
    assert np.array_equal(team.agents["car_0"].rollout_buffer.rewards, model.rollout_buffer.rewards)


def test_recurrent_and_masked_partners_act_as_in_an_agent_env(tmp_path):
    """In each copy as in an ``AgentEnv`` of its own: deterministic, since all copies' samples are of one stream."""
    recurrent = saved_team(tmp_path / "recurrent.zip", RecurrentPPO, "MlpLstmPolicy", policy_kwargs={"lstm_hidden_size": 8})
    env = partnered({"agent_1": recurrent}, n_envs=3, seed=5, deterministic=True)
    did = [actions for actions, _ in play(env, 20, begin=True)]
    for copy in range(3):
        alone = AgentEnv(toy(2), "agent_0", recurrent, deterministic=True)
        alone.reset(seed=5 + copy)
        for actions in did:
            _, _, terminated, truncated, info = alone.step(1)
            assert info["others_actions"].argmax() == actions[copy]
            if terminated or truncated:
                alone.reset()

    def masked():
        return MaskedEnv(3)

    Team(MaskablePPO, "MlpPolicy", make_team_env(masked), seed=0, **PPO_KWARGS).save(tmp_path / "masked.zip")

    @batched
    def allowed(obs, action_masks):
        return action_masks.argmax(axis=1)

    # MaskedEnv raises if an action is masked out
    for partner in (str(tmp_path / "masked.zip"), allowed, lambda obs, action_masks: int(action_masks.argmax())):
        masked_env: Any = PartnersVecEnv(make_team_env(masked, n_envs=2), {"agent_1": partner})
        masked_env.reset()
        for t in range(20):
            assert masked_env.action_masks()["agent_0"].argmax(axis=1).tolist() == [t % 7 % 3] * 2
            masked_env.step({"agent_0": np.full(2, t % 7 % 3), "agent_2": np.zeros(2, int)})


def test_a_function_of_batches_is_called_once_a_step():
    seen = []

    @batched
    def thirds(obs, rng):
        seen.append(obs.shape)
        return rng.integers(3, size=len(obs))

    def third(obs, rng):
        return rng.integers(3)

    runs = [play(partnered({"agent_1": thirds}, n_envs=4, seed=s), 9, begin=True) for s in (1, 1, 2)]
    assert seen == [(4, 2)] * 27 and runs[0] == runs[1] != runs[2]
    # In one copy it draws the same as a function of single observations
    single = [play(partnered({"agent_1": fn}, n_envs=1, seed=1), 9, begin=True) for fn in (thirds, third)]
    assert single[0] == single[1]
    agent_env = AgentEnv(toy(2), "agent_0", {"agent_1": thirds})
    agent_env.reset(seed=1)
    assert [agent_env.step(1)[4]["others_actions"].argmax() for _ in range(7)] == [d[0] for d, _ in single[0][:7]]

    @batched
    def one_for_all(obs):
        return 1

    with pytest.raises(ValueError, match="given 2 observations it must return 2 actions"):
        play(partnered({"agent_1": one_for_all}), 1, begin=True)
    with pytest.raises(ValueError, match=r"must return actions of the shape \(2,\)"):
        play(partnered({"agent_1": lambda obs: [1]}), 1, begin=True)
    for wrong in (None, 7, -1, 0.5):
        with pytest.raises(ValueError, match=rf"must return actions of its action space, Discrete\(3\), got {wrong}\."):
            play(partnered({"agent_1": lambda obs, wrong=wrong: wrong}), 1, begin=True)


def test_learners_meet_what_they_meet_without_partners():
    """What the environment returns for the learners, with the partners' actions after the other learners'."""
    rng = np.random.default_rng(0)
    joint, env = make_team_env(MixedEnv, n_envs=2, seed=3), make_team_env(MixedEnv, n_envs=2, seed=3)
    did: dict[str, Any] = {}
    partners = {
        "multi": batched(lambda obs: did["multi"]),
        "zeta": batched(lambda obs: did["zeta"]),
    }
    env = PartnersVecEnv(env, partners)
    assert env.possible_agents == ["box", "binary"] and list(env.scripted_action_spaces) == ["zeta", "multi"]
    first, expected_first = env.reset(), joint.reset()
    assert first.keys() == {"box", "binary"} and all(np.array_equal(first[a], expected_first[a]) for a in first)
    for _ in range(12):
        did.update(
            zeta=rng.integers(3, size=2),
            box=rng.uniform(-1, 1, (2, 2)).astype(np.float32),
            multi=np.stack([rng.integers(2, size=2), rng.integers(3, size=2)], axis=1),
            binary=rng.integers(2, size=(2, 2)),
        )
        obs, rewards, dones, infos = env.step({agent: did[agent] for agent in ("box", "binary")})
        expected = joint.step(did)
        assert np.array_equal(dones, expected[2]) and all(np.array_equal(obs[a], expected[0][a]) for a in obs)
        for i, (info, other) in enumerate(zip(infos, expected[3], strict=True)):
            # zeta, box, multi, binary: rows of box and binary; the columns of box are [binary, zeta, multi]
            assert (
                info["visible"].tolist()
                == other["visible"][[1, 3]][[0, 1], :][np.arange(2)[:, None], [[2, 0, 1], [1, 0, 2]]].tolist()
            )
            assert np.array_equal(info["agent_rewards"], other["agent_rewards"][[1, 3]])
            assert rewards[i] == pytest.approx(info["agent_rewards"].mean())
            zeta, (a, b) = did["zeta"][i], did["multi"][i]
            wanted = [*np.eye(3)[zeta], *np.eye(2)[a], *np.eye(3)[b]]
            assert info["scripted_actions"].tolist() == wanted and info["scripted_actions"].dtype == np.float32
            if dones[i]:
                assert info["terminal_observation"].keys() == {"box", "binary"}
                assert len(info["agent_episode_rewards"]) == 2


def test_ends_of_learners_and_of_partners_are_kept_apart():
    starts = []

    class Watching:
        def predict(self, obs, state=None, episode_start=None, deterministic=False):
            starts.append(episode_start.tolist())
            return np.zeros(len(obs), int), None

    env = PartnersVecEnv(make_team_env(ScriptedEnv, n_envs=2), {"stays": Watching(), "cut": zero})
    env.reset()
    lives = [info for _ in range(9) for info in env.step(dict.fromkeys(("dies", "last"), np.zeros(2, int)))[3][:1]]
    # The life of "stays" ends at step 3, and the team's episode at step 8
    assert starts == [[t in (0, 3, 8)] * 2 for t in range(9)]
    assert [info["life_end"].tolist() for info in lives[:8]] == [[t == 4, False] for t in range(8)]
    assert [info["truncated"].tolist() for info in lives[:8]] == [[False, t == 7] for t in range(8)]
    # "dies" sees [last, stays, cut]: "stays" waits at steps 4 and 5, after which it has left itself
    assert [info["visible"][0].tolist() for info in lives[2:6]] == [[True] * 3, *[[True, False, True]] * 2, [False] * 3]


def test_the_environments_own_scripted_others_follow_the_partners():
    env = PartnersVecEnv(make_team_env(PartneredEnv), {"ball": lambda obs: np.array([0.5], np.float32)})
    assert list(env.scripted_action_spaces) == ["ball", "wind", "leader"]
    env.reset()
    infos = env.step({"arrow": np.zeros(1, int)})[3]
    assert infos[0]["scripted_actions"].tolist() == [0.5, 1, -1, 1, 0, 0, 0]


def test_a_team_learns_saves_and_loads_beside_partners(tmp_path):
    partners = {"agent_1": zero}
    team = Team(PPO, "MlpPolicy", make_team_env(toy(3), n_envs=2), seed=0, partners=partners, **PPO_KWARGS).learn(32)
    assert list(team.agents) == ["agent_0", "agent_2"]
    assert list(team.agents["agent_0"].get_env().get_attr("others_action_spaces")[0]) == ["agent_2", "agent_1"]
    team.save(tmp_path / "team.zip")
    env = make_team_env(toy(3), n_envs=2)
    with pytest.raises(ValueError, match=r"Partners acted for \['agent_1'\] when the team learned: give them"):
        Team.load(tmp_path / "team.zip", env=env)
    with pytest.raises(ValueError, match=r"Partners acted for \['agent_1'\] when the team learned: give them"):
        team.set_env(env)
    loaded = Team.load(tmp_path / "team.zip", env=env, partners={"agent_1": one}, device="cpu")
    assert np.array_equal(parameters(loaded.agents["agent_2"]), parameters(team.agents["agent_2"]))
    loaded.learn(16)
    # Without the partners the team cannot be evaluated, and with them it is by what the learners get
    with pytest.raises(ValueError, match=r"Partners acted for \['agent_1'\].*PartnersVecEnv\(env, partners\)"):
        evaluate_policy(team, env, n_eval_episodes=1)
    eval_env = PartnersVecEnv(env, partners)
    returns, lengths = cast(Any, evaluate_policy(team, VecMonitor(eval_env), 4, return_episode_rewards=True))
    assert len(returns) == 4 and lengths == [7] * 4


@pytest.mark.parametrize("schedule", [None, {}, {"redraw_unit": "rollouts", "per_copy": False}])
def test_partners_need_no_worker_and_do_not_change_with_jobs(schedule):
    partner: Any = noisy if schedule is None else PartnerPool({"noisy": noisy, "zero": zero}, **schedule)

    def learned(jobs, vec_env="dummy"):
        env = make_team_env(ToyEnv, n_envs=2, vec_env=vec_env, env_kwargs={"n_agents": 3})
        team = Team(BeliefPPO, "BeliefPolicy", env, seed=1, partners={"agent_0": partner}, jobs=jobs, **BELIEF)
        weights = [parameters(model) for model in team.learn(48).agents.values()]
        env.close()
        return np.stack(weights)

    assert np.array_equal(learned(1), learned(2)) and np.array_equal(learned(1), learned(1, "subproc"))


def test_learners_do_not_depend_on_what_partners_draw():
    """The agents of a ``ToyEnv`` do not influence each other."""
    weights = []
    for partner in (zero, noisy, A2C("MlpPolicy", AgentEnv(toy(1), "agent_0", {}), n_steps=8, device="cpu")):
        env = make_team_env(toy(2), n_envs=2)
        weights.append(
            parameters(
                Team(PPO, "MlpPolicy", env, seed=2, partners={"agent_1": partner}, **PPO_KWARGS).learn(32).agents["agent_0"]
            )
        )
    assert all(np.array_equal(each, weights[0]) for each in weights)


def test_partners_sample_anew_with_another_seed_and_go_on_without_one():
    env = partnered({"agent_1": noisy}, seed=4)
    first = play(env, 14, begin=True)
    assert play(env, 14, begin=True) != first
    env.seed(4)
    assert play(env, 14, begin=True) == first
    env.seed(5)
    assert play(env, 14, begin=True) != first


def test_monitor_files_and_attributes_are_those_of_the_learners(tmp_path):
    inner = make_team_env(toy(2), n_envs=2, seed=0)
    env = PartnersVecEnv(inner, {"agent_0": zero})
    env.start_monitor(str(tmp_path))
    play(env, 8, begin=True)
    env.close()
    assert {path.name for path in (tmp_path / "agents").iterdir()} == {"agent_1.monitor.csv"}
    assert env.get_attr("limit") == [7, 7] and env.get_attr("possible_agents")[0] == ["agent_1"]
    env.set_attr("limit", 3)
    assert inner.get_attr("limit") == [3, 3] and env.env_method("observations")[0].keys() == {"agent_0", "agent_1"}
    with pytest.raises(AttributeError, match="partner"):
        env.get_attr("partner")


@pytest.mark.parametrize(
    "partners, error, message",
    [
        ({}, ValueError, "partners is empty"),
        ({"bob": zero}, ValueError, r"unknown agents \['bob'\]; the environment has \['agent_0', 'agent_1'\]"),
        ({"agent_0": zero, "agent_1": zero}, ValueError, "none is left to learn"),
        ("team.zip", TypeError, "must be a dict {agent: partner or PartnerPool}, not str"),
        ({"agent_1": 3}, TypeError, "The partner 'agent_1' is 3; it must be"),
        ({"agent_1": "nothing.zip"}, FileNotFoundError, "There is no 'nothing.zip'"),
    ],
)
def test_wrong_partners(partners, error, message):
    with pytest.raises(error, match=message):
        Team(PPO, "MlpPolicy", make_team_env(toy(2)), partners=partners, **PPO_KWARGS)


def test_an_agent_learns_or_has_a_partner():
    both: dict[str, Any]
    for both in ({"agent_kwargs": {"agent_1": {"n_steps": 16}}}, {"policy": {"agent_0": "MlpPolicy", "agent_1": "MlpPolicy"}}):
        kwargs = {"algo_class": PPO, "policy": "MlpPolicy", **PPO_KWARGS, **both}
        with pytest.raises(ValueError, match=r"has entries for \['agent_1'\], but partners act for them"):
            Team(env=make_team_env(toy(2)), partners={"agent_1": zero}, **kwargs)


def test_partners_that_do_not_fit(tmp_path):
    junction = Team(PPO, "MlpPolicy", make_team_env(EASY), seed=0, **PPO_KWARGS).agents["car_1"]
    with pytest.raises(ValueError, match="'agent_1' has been made for the observation space"):
        partnered({"agent_1": junction})
    with pytest.raises(TypeError, match="put wrappers around the PartnersVecEnv"):
        Team(PPO, "MlpPolicy", VecMonitor(make_team_env(toy(2))), partners={"agent_1": zero}, **PPO_KWARGS)
    # A zip of SB3 alone is a pickle, which a team does not read unless it is told to
    PPO("MlpPolicy", AgentEnv(toy(1), "agent_0", {}), **PPO_KWARGS).save(tmp_path / "model.zip")
    partners = {"agent_1": str(tmp_path / "model.zip")}
    with pytest.raises(ValueError, match="a pickle can run any code"):
        partnered(partners)
    assert len(play(partnered(partners, trust_pickle=True), 3, begin=True)) == 3
