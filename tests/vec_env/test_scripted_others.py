"""Scripted others are partners that belong to the environment. Each agent sees their actions as it sees its teammates'."""

from functools import partial
from typing import Any, ClassVar

import numpy as np
import pytest
import supersuit
from gymnasium import spaces
from pettingzoo.utils import BaseParallelWrapper
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor

from sb3_belief.belief_ppo import BeliefPPO
from sb3_belief.team import JointEnv, TeamVecEnv
from sb3_belief.team.checkpoint import SavedTeam
from sb3_belief.team.lockstep.joint_loop import JointLoop
from sb3_belief.vec_env.agent_vec_env import TransitionSplitter
from tests.team.helpers import PPO_KWARGS, Record, Team, make_team_env
from tests.team.toy_envs import BlinkingEnv, MixedEnv, PartneredEnv, ToyEnv

SMALL: dict[str, Any] = {**PPO_KWARGS, "n_steps": 12, "batch_size": 12}
BELIEF: dict[str, Any] = {
    **SMALL,
    "history_length": 24,
    "policy_kwargs": {"net_arch": [8], "embedding_dim": 8, "latent_dim": 4},
}


def play(env, n_steps, seed=0):
    """
    Play random actions.

    :return: The loop, and for each step the joint actions, the joint step and the agents' transitions
    """
    loop = JointLoop(env)
    env.reset()
    rng = np.random.default_rng(seed)
    record = []
    for _ in range(n_steps):
        ball = rng.uniform(-1, 1, (env.num_envs, 1)).astype(np.float32)
        actions = {"arrow": rng.integers(0, 3, env.num_envs), "ball": ball}
        step = env.step(actions)
        record.append((actions, step, loop._splitter.split(actions, step)))
    return loop, record


@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
@pytest.mark.parametrize("env_class", [PartneredEnv, BlinkingEnv])
def test_agents_are_told_what_they_could_see(env_class, vec_env):
    env = make_team_env(env_class, n_envs=2, vec_env=vec_env)
    loop, record = play(env, 14)
    for agent, other in (("arrow", "ball"), ("ball", "arrow")):
        others_spaces = loop.agent_envs[agent].get_attr("others_action_spaces")[0]
        assert list(others_spaces) == [other, "wind", "leader"]
        assert others_spaces["wind"] == spaces.Box(-100, 100, (2,), np.float32) and others_spaces["leader"] == spaces.Discrete(
            4
        )
    for k, (actions, step, (arrow, ball)) in enumerate(record):
        t, episode = k % 6 + 1, k // 6 + 1
        wind, leader = [t, -episode], [float(a == (t - 1) % 4) for a in range(4)]
        bits = [bool(t & 1), bool(t & 2), bool(t & 4)] if env_class is BlinkingEnv else [True] * 3
        rest = [not bit for bit in bits] if env_class is BlinkingEnv else [True] * 3
        in_play = t <= 3
        for e in range(2):
            assert step[3][e]["scripted_actions"].dtype == np.float32
            assert step[3][e]["scripted_actions"].tolist() == [*wind, *leader]
            seen_by_arrow = [bits[0] and in_play, bits[1], bits[2]]
            seen_by_ball = [in_play and seen for seen in rest]
            one_hot = [float(a == actions["arrow"][e]) for a in range(3)]
            expectations: Any = (
                (arrow[3][e], seen_by_arrow, ([float(actions["ball"][e, 0])], wind, leader)),
                (ball[3][e], seen_by_ball, (one_hot, wind, leader)),
            )
            for info, seen, others in expectations:
                assert info["others_visible"].tolist() == seen
                expected = [x if is_seen else 0.0 for action, is_seen in zip(others, seen, strict=True) for x in action]
                assert info["others_actions"].dtype == np.float32
                assert info["others_actions"].tolist() == expected
    # At the last step of an episode the actions are those of that step, not those after the reset
    assert record[5][1][2].all() and record[5][1][3][0]["scripted_actions"].tolist() == [6, -1, 0, 1, 0, 0]
    env.close()


def test_workers_equal_in_process():
    runs = []
    for vec_env in ("dummy", "subproc"):
        env = make_team_env(BlinkingEnv, n_envs=3, seed=1, vec_env=vec_env)
        runs.append([transitions for *_, transitions in play(env, 14)[1]])
        env.close()
    for first, second in zip(*runs, strict=True):
        for one, two in zip(first, second, strict=True):
            assert all(np.array_equal(x, y) for x, y in zip(one[:3], two[:3], strict=True))
            for info, info2 in zip(one[3], two[3], strict=True):
                assert info.keys() == info2.keys()
                assert all(np.array_equal(info[key], info2[key]) for key in ("others_actions", "others_visible", "active"))


@pytest.mark.parametrize("sees", [True, False])
def test_nothing_of_an_invisible_scripted_action_reaches_an_agent(sees):
    agent_spaces: dict[str, spaces.Space] = {"a": spaces.Discrete(2), "b": spaces.Discrete(2)}
    splitter = TransitionSplitter(["a", "b"], agent_spaces, {"x": spaces.Box(-1, 1, (2,)), "y": spaces.MultiDiscrete([2, 3])})
    info = {
        "agent_rewards": np.zeros(2, np.float32),
        "visible": np.array([[True, sees, True], [True, True, True]]),
        "active": np.ones(2, bool),
        **{key: np.zeros(2, bool) for key in ("life_end", "truncated")},
        "scripted_actions": np.array([np.nan, 0.5, 0, 1, 1, 0, 0], np.float32),
    }
    obs = {"a": np.zeros((1, 1)), "b": np.zeros((1, 1))}
    actions = {"a": np.ones(1, int), "b": np.zeros(1, int)}
    a, b = splitter.split(actions, (obs, np.zeros(1), np.zeros(1, bool), [info]))
    others_actions = a[3][0]["others_actions"]
    np.testing.assert_array_equal(others_actions, [1, 0, *([np.nan, 0.5] if sees else [0, 0]), 0, 1, 1, 0, 0])
    np.testing.assert_array_equal(b[3][0]["others_actions"], [0, 1, np.nan, 0.5, 0, 1, 1, 0, 0])


@pytest.mark.parametrize("env_class", [ToyEnv, MixedEnv])
def test_without_scripted_others_nothing_is_said_of_them(env_class):
    env = make_team_env(env_class)
    assert env.scripted_action_spaces == {}
    env.reset()
    assert set(env.step({agent: env.action_space[agent].sample()[None] for agent in env.possible_agents})[3][0]) == {
        "agent_rewards",
        "visible",
        "active",
        "life_end",
        "truncated",
    }


class Changed(PartneredEnv):
    """
    A ``PartneredEnv`` with other scripted actions, spaces or visibility.

    :param replaced: Scripted actions that replace those of the class
    :param scripted_spaces: ``scripted_action_spaces``. None for those of the class
    :param rows: What ``visibility()`` returns. None for no ``visibility()``
    """

    def __init__(self, replaced=None, scripted_spaces=None, rows=None):
        super().__init__()
        self.replaced = replaced
        if scripted_spaces is not None:
            self.scripted_action_spaces = scripted_spaces
        if rows is not None:
            self.visibility = lambda: rows

    def scripted_actions(self):
        return {**super().scripted_actions(), **self.replaced} if self.replaced else super().scripted_actions()


@pytest.mark.parametrize("action", [4, -1, 1.0, [1], None, "gas"])
def test_actions_that_do_not_fit_a_discrete_space(action):
    env = JointEnv(Changed(replaced={"leader": action}))
    env.reset()
    with pytest.raises(ValueError, match=r"for 'leader', which is no action of Discrete\(4\): return what it did"):
        env.step({"arrow": 0, "ball": [0.0]})


@pytest.mark.parametrize("action", [0.5, [0.5], [[0.5, 0.5]], ["a", "b"]])
def test_actions_that_do_not_fit_a_box(action):
    env = JointEnv(Changed(replaced={"wind": action}))
    env.reset()
    with pytest.raises(ValueError, match=r"for 'wind', which is no action of Box\(.*correct its entry"):
        env.step({"arrow": 0, "ball": [0.0]})


def test_actions_of_every_kind_of_space():
    kinds = {"x": spaces.MultiDiscrete([2, 3]), "y": spaces.MultiBinary(2), "z": spaces.Box(-1, 1, (2, 2))}
    scripted = {"z": [[0.5, -1], [7, 0]], "y": [True, False], "x": (1, 0)}

    class Kinds(Changed):
        def scripted_actions(self):
            return scripted

    env = make_team_env(Kinds, env_kwargs={"scripted_spaces": kinds})
    env.reset()
    actions = {"arrow": [0], "ball": [[0.0]]}
    # MultiDiscrete is one-hot for each dimension. MultiBinary and Box keep their numbers, also those out of bounds
    assert env.step(actions)[3][0]["scripted_actions"].tolist() == [0, 1, 1, 0, 0, 1, 0, 0.5, -1, 7, 0]
    for name, wrong in (("x", [2, 0]), ("x", [1]), ("y", [2, 0]), ("y", [1, 0, 0])):
        scripted = {**scripted, name: wrong}
        with pytest.raises(ValueError, match=f"for '{name}', which is no action of Multi"):
            env.step(actions)
        scripted = {"z": np.zeros((2, 2)), "y": [1, 1], "x": [0, 2]}


def test_actions_of_the_wrong_partners():
    env = JointEnv(Changed(replaced={"ghost": 0}))
    env.reset()
    with pytest.raises(ValueError, match=r"each of \['wind', 'leader'\]: missing \[\], unknown \['ghost'\]"):
        env.step({"arrow": 0, "ball": [0.0]})
    box = spaces.Box(-1, 1, (2,))
    env = JointEnv(Changed(scripted_spaces={"wind": box, "leader": spaces.Discrete(4), "tide": box}))
    env.reset()
    with pytest.raises(ValueError, match=r"missing \['tide'\]"):
        env.step({"arrow": 0, "ball": [0.0]})


@pytest.mark.parametrize("n_flags", [{"arrow": 1, "ball": 1}, {"arrow": 3, "ball": 1}, {"arrow": 4, "ball": 4}])
def test_visibility_of_the_wrong_length(n_flags):
    env = JointEnv(Changed(rows={agent: np.ones(n, bool) for agent, n in n_flags.items()}))
    env.reset()
    with pytest.raises(ValueError, match=r"3 flags for each agent.*scripted others \['wind', 'leader'\]"):
        env.step({"arrow": 0, "ball": [0.0]})


def test_half_of_the_two_members():
    class Mute(ToyEnv):
        scripted_action_spaces: ClassVar[Any] = {"x": spaces.Discrete(2)}

    class Spaceless(ToyEnv):
        def scripted_actions(self):
            return {"x": 0}

    class Mistaken(Mute, Spaceless):
        scripted_action_spaces = spaces.Discrete(2)

    with pytest.raises(TypeError, match=r"Mute has scripted_action_spaces but not scripted_actions\(\)"):
        make_team_env(Mute)
    with pytest.raises(TypeError, match=r"Spaceless has scripted_actions\(\) but not scripted_action_spaces"):
        make_team_env(Spaceless)
    with pytest.raises(TypeError, match=r"must be a dict .* got Discrete"):
        make_team_env(Mistaken)


@pytest.mark.parametrize(
    "scripted_spaces, says",
    [
        ({"ball": spaces.Discrete(2)}, r"entries for \['ball'\], which are agents.*must differ"),
        ({"x": spaces.Dict({"y": spaces.Discrete(2)})}, "of 'x' is Dict.*allowed are Discrete, MultiDiscrete"),
        ({"x": spaces.Discrete(2, start=1)}, "of 'x' is .*start=0"),
    ],
)
def test_spaces_that_are_refused(scripted_spaces, says):
    with pytest.raises(ValueError, match=says):
        make_team_env(Changed, env_kwargs={"scripted_spaces": scripted_spaces})


class Batched(TeamVecEnv):
    """
    Vectorised environment of one learner and one scripted other.

    :param info: Entries that replace those of the infos, None for entries to leave out
    :param num_envs: Number of copies
    """

    def __init__(self, info, num_envs=2):
        super().__init__(
            num_envs,
            ["solo"],
            {"solo": spaces.Box(0, 1, (1,))},
            {"solo": spaces.Discrete(2)},
            scripted_action_spaces={"leader": spaces.Discrete(3)},
        )
        self.info = info

    def _reset_joint(self):
        return {"solo": np.zeros((self.num_envs, 1), np.float32)}

    def _step_joint(self, actions):
        info = {
            "agent_rewards": np.ones(1, np.float32),
            "visible": np.ones((1, 1), bool),
            "active": np.ones(1, bool),
            **{key: np.zeros(1, bool) for key in ("life_end", "truncated")},
            "scripted_actions": np.array([0, 0, 1], np.float32),
            **self.info,
        }
        infos = [{key: value for key, value in info.items() if value is not None} for _ in range(self.num_envs)]
        return self._reset_joint(), np.ones(self.num_envs, np.float32), np.zeros(self.num_envs, bool), infos


def test_vectorised_environment_of_ones_own():
    env = Batched({})
    team = Team(BeliefPPO, "BeliefPolicy", env, seed=0, **BELIEF).learn(24)
    buffer = team.agents["solo"].rollout_buffer
    assert buffer.others_visible.all()
    np.testing.assert_array_equal(buffer.others_actions.reshape(-1, 3), np.tile([0, 0, 1], (24, 1)))


@pytest.mark.parametrize(
    "info, says",
    [
        ({"scripted_actions": None}, r"scripted others \['leader'\] must have 'scripted_actions' of shape \(3,\), got \[None"),
        ({"scripted_actions": np.zeros(2)}, r"'scripted_actions' of shape \(3,\), got \[\(2,\), \(2,\)\]"),
        ({"visible": np.zeros((1, 0), bool)}, r"'visible' of shape \(1, 1\), got \[\(1, 0\)"),
    ],
)
def test_vectorised_environment_that_says_the_wrong_things(info, says):
    team = Team(PPO, "MlpPolicy", Batched(info), seed=0, **SMALL)
    with pytest.raises(ValueError, match=says):
        team.learn(24)


@pytest.mark.parametrize("wrapper", [BaseParallelWrapper, partial(supersuit.dtype_v0, dtype=np.float64)])
def test_wrappers_of_pettingzoo_and_supersuit_pass_them_on(wrapper):
    env = make_team_env(BlinkingEnv, wrapper=wrapper)
    assert list(env.scripted_action_spaces) == ["wind", "leader"]
    _, record = play(env, 5)
    assert record[4][1][3][0]["scripted_actions"].tolist() == [5, -1, 1, 0, 0, 0]
    assert record[4][1][3][0]["visible"].tolist() == [[False, False, True], [False, False, False]]


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("wrap", [None, VecMonitor])
def test_a_team_learns_with_a_belief_about_them(normalize, wrap):
    env = make_team_env(partial(PartneredEnv, ball_leaves=False), n_envs=2)
    team = Team(BeliefPPO, "BeliefPolicy", env if wrap is None else wrap(env), seed=0, normalize=normalize, **BELIEF)
    record = Record()
    team.learn(72, callback=record)
    assert record.steps == 36
    for agent, other, own_width in (("arrow", "ball", 1), ("ball", "arrow", 3)):
        model = team.agents[agent]
        assert list(model.others_action_spaces) == [other, "wind", "leader"]
        assert list(model.get_env().get_attr("others_action_spaces")[0]) == [other, "wind", "leader"]
        buffer = model.rollout_buffer
        # After the update the rows of a copy stand one after the other. The third rollout is two episodes of 6 steps
        others_actions = buffer.others_actions.reshape(2, 12, -1)[0]
        assert others_actions.shape == (12, own_width + 2 + 4)
        assert buffer.others_visible.all()
        np.testing.assert_array_equal(others_actions[:, own_width], [1, 2, 3, 4, 5, 6] * 2)
        np.testing.assert_array_equal(others_actions[:, own_width + 2 :], np.eye(4)[[0, 1, 2, 3, 0, 1] * 2])
        assert np.isfinite(model.logger.name_to_value["belief/action_loss"])
        assert model.logger.name_to_value["belief/first_log_ratio"] < 1e-5


def test_stock_models_learn_beside_them():
    team = Team(PPO, "MlpPolicy", make_team_env(BlinkingEnv, n_envs=2), seed=0, **SMALL)
    record = Record(keep=("infos",))
    team.learn(24, agent_callbacks={"arrow": record})
    assert record.steps == 12
    assert record.kept[3]["infos"][0]["others_actions"].tolist() == [0, 0, 0, 0, 0, 0, 1]
    assert record.kept[3]["infos"][1]["others_visible"].tolist() == [False, False, True]


@pytest.mark.parametrize("algo_class, policy", [(BeliefPPO, "BeliefPolicy"), (PPO, "MlpPolicy")])
def test_save_and_load(tmp_path, algo_class, policy):
    kwargs = BELIEF if algo_class is BeliefPPO else SMALL
    team = Team(algo_class, policy, make_team_env(PartneredEnv, n_envs=2), seed=0, **kwargs).learn(24)
    team.save(tmp_path / "team")
    obs = make_team_env(PartneredEnv).reset()
    # A team that was loaded without an environment still saves which scripted others it has learned with
    Team.load(tmp_path / "team").save(tmp_path / "again")
    loaded = Team.load(tmp_path / "again", env=make_team_env(BlinkingEnv, n_envs=3))
    for agent, action in team.predict(obs, deterministic=True)[0].items():
        np.testing.assert_array_equal(action, loaded.predict(obs, deterministic=True)[0][agent])
    loaded.learn(36)
    box, discrete = PartneredEnv().scripted_action_spaces.values()
    for others in ({}, {"leader": discrete, "wind": box}, {"wind": box, "leader": spaces.Discrete(5)}):
        other = make_team_env(Changed, n_envs=2, env_kwargs={"scripted_spaces": others})
        with pytest.raises(ValueError, match=r"scripted others saved as \{'wind'.* environment has \{"):
            Team.load(tmp_path / "team", env=other)
        with pytest.raises(ValueError, match=r"learned with the scripted others \{'wind'.* environment has \{"):
            team.set_env(other)
    team.set_env(make_team_env(BlinkingEnv, n_envs=2))
    team.learn(24)


def test_files_that_tell_nothing_of_scripted_others_had_none():
    env = make_team_env(ToyEnv)
    words = {agent: str(env.observation_space[agent]) for agent in env.possible_agents}
    actions = {agent: str(env.action_space[agent]) for agent in env.possible_agents}
    manifest = {"agents": env.possible_agents, "observation_spaces": words, "action_spaces": actions}
    saved = SavedTeam(manifest, {}, {})
    saved.check_env(env, env.possible_agents, saved.scripted)
    with pytest.raises(ValueError, match=r"scripted others saved as \{\}, environment has \{'x': 'Discrete"):
        saved.check_env(env, env.possible_agents, {"x": "Discrete(2)"})
