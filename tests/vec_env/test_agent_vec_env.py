"""What each agent gets of a joint step."""

import time
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from sb3_belief.team.lockstep.joint_loop import JointLoop
from sb3_belief.vec_env.agent_vec_env import TransitionSplitter
from tests.team.helpers import make_team_env
from tests.team.toy_envs import MixedEnv, ScriptedEnv

AGENTS = ["zeta", "box", "multi", "binary"]


def sample(env, rng_seed):
    """Return random joint actions, ``[num_envs, ...]`` by agent."""
    for i, agent in enumerate(AGENTS):
        env.action_space[agent].seed(rng_seed + i)
    return {agent: np.array([env.action_space[agent].sample() for _ in range(env.num_envs)]) for agent in AGENTS}


def test_others_actions_are_what_gymnasium_flattens():
    env = make_team_env(MixedEnv, n_envs=3)
    loop = JointLoop(env)
    env.reset()
    for t in range(7):
        actions = sample(env, 10 * t)
        transitions = loop._splitter.split(actions, step := env.step(actions))
        for i, (agent, transition) in enumerate(zip(AGENTS, transitions, strict=True)):
            others = [other for other in AGENTS if other != agent]
            assert np.array_equal(transition[1], [info["agent_rewards"][i] for info in step[3]])
            for e, info in enumerate(transition[3]):
                assert info["others_visible"].tolist() == step[3][e]["visible"][i].tolist()
                expected = [
                    spaces.flatten(env.action_space[other], actions[other][e]) * visible
                    for other, visible in zip(others, info["others_visible"], strict=True)
                ]
                assert info["others_actions"].dtype == np.float32
                assert info["others_actions"].tolist() == np.concatenate(expected).astype(np.float32).tolist()
                assert info["active"] is True
        others_spaces = loop.agent_envs["multi"].get_attr("others_action_spaces")
        assert len(others_spaces) == 3 and type(others_spaces[0]) is dict
        assert list(others_spaces[0].items()) == [(other, env.action_space[other]) for other in ("zeta", "box", "binary")]


def test_nothing_of_invisible_actions_reaches_an_agent():
    def bits(infos):
        return [
            {key: value.tobytes() if isinstance(value, np.ndarray) else value for key, value in info.items()} for info in infos
        ]

    env = make_team_env(MixedEnv, n_envs=2)
    splitter = TransitionSplitter(AGENTS, {agent: env.action_space[agent] for agent in AGENTS})
    env.reset()
    actions = sample(env, 0)
    step = env.step(actions)
    before = splitter.split(actions, step)
    for j, other in enumerate(AGENTS):
        changed = {**actions, other: sample(env, 50)[other]}
        if other == "box":
            changed["box"] = np.full((2, 2), np.nan, dtype=np.float32)
        assert not np.array_equal(changed[other], actions[other])
        after = splitter.split(changed, step)
        for i in range(4):
            if i == j:
                continue
            visible = step[3][0]["visible"][i][j - (j > i)]
            assert (bits(after[i][3]) == bits(before[i][3])) == (not visible)


def test_who_ends_when():
    env = make_team_env(ScriptedEnv)
    splitter = TransitionSplitter(env.possible_agents, {agent: env.action_space[agent] for agent in env.possible_agents})
    env.reset()
    actions = {agent: np.ones(1, int) for agent in env.possible_agents}
    steps = [splitter.split(actions, env.step(actions)) for _ in range(8)]
    stays, dies, cut, last = zip(*steps, strict=True)
    dones = [[int(step[2][0]) for step in agent] for agent in (stays, dies, cut, last)]
    assert dones == [[0, 0, 1, 0, 0, 0, 0, 1], [0, 0, 0, 0, 1, 0, 0, 1], [0, 0, 0, 0, 0, 1, 0, 1], [0] * 7 + [1]]
    ends = {
        name: {t + 1: info for t, step in enumerate(agent) if "terminal_observation" in (info := step[3][0])}
        for name, agent in {"stays": stays, "dies": dies, "cut": cut, "last": last}.items()
    }
    limits = {name: {t: info["TimeLimit.truncated"] for t, info in infos.items()} for name, infos in ends.items()}
    assert limits == {
        "stays": {3: False, 8: True},
        "dies": {5: False, 8: False},
        "cut": {6: True, 8: False},
        "last": {8: True},
    }
    assert ends["cut"][6]["terminal_observation"].tolist() == [6, 10]
    assert cut[5][0].tolist() == [[0, 0]]
    assert ends["last"][8]["terminal_observation"].tolist() == [8, 10]
    # "episode" holds the agent's own return over the team's whole episode, and appears only at its end
    assert ["episode" in step[3][0] for step in dies] == [False] * 7 + [True]
    assert dies[-1][3][0]["episode"]["r"] == pytest.approx(sum(11 + t / 100 for t in range(1, 9)), rel=1e-6)
    assert dies[-1][3][0]["episode"]["l"] == 8 and dies[-1][3][0]["is_success"] is False
    assert [step[3][0]["active"] for step in stays] == [True, True, True, False, False, True, True, True]


def test_an_inactive_slot_is_not_bootstrapped():
    splitter = TransitionSplitter(["a", "b"], {"a": spaces.Discrete(2), "b": spaces.Discrete(2)})
    info = {
        "agent_rewards": np.zeros(2, np.float32),
        "visible": np.zeros((2, 1), bool),
        "active": np.array([False, True]),
        "life_end": np.zeros(2, bool),
        "truncated": np.ones(2, bool),
        "terminal_observation": {"a": np.zeros(1), "b": np.zeros(1)},
    }
    actions = {"a": np.zeros(1, int), "b": np.zeros(1, int)}
    obs = {"a": np.zeros((1, 1)), "b": np.zeros((1, 1))}
    a, b = splitter.split(actions, (obs, np.zeros(1), np.ones(1, bool), [info]))
    assert a[3][0]["TimeLimit.truncated"] is False and b[3][0]["TimeLimit.truncated"] is True


def test_masks_of_the_next_episode_are_not_those_of_an_end():
    """Where an environment does not say its last masks, the present ones are of that episode only if the team plays on."""
    splitter = TransitionSplitter(["a"], {"a": spaces.Discrete(2)})
    info = {
        "agent_rewards": np.zeros(1, np.float32),
        "visible": np.zeros((1, 0), bool),
        "active": np.ones(1, bool),
        "life_end": np.ones(1, bool),
        "truncated": np.zeros(1, bool),
    }
    ends = {**info, "terminal_observation": {"a": np.zeros(1)}, "episode": {"r": 0.0}, "agent_episode_rewards": np.zeros(1)}
    step: Any = ({"a": np.zeros((2, 1))}, np.zeros(2), np.array([True, False]), [ends, info])
    masks = {"a": np.array([[True, False], [False, True]])}
    (transition,) = splitter.transitions({"a": np.zeros(2, int)}, step, lambda: masks)
    ended, lives_on = transition.as_step()[3]
    assert "terminal_action_masks" not in ended and lives_on["terminal_action_masks"].tolist() == [False, True]


def test_transitions_share_no_memory():
    env = make_team_env(MixedEnv, n_envs=2)
    splitter = TransitionSplitter(AGENTS, {agent: env.action_space[agent] for agent in AGENTS})
    env.reset()
    step = env.step(actions := sample(env, 0))
    transitions = splitter.split(actions, step)
    transitions[0][1][:] = 77.0
    transitions[0][2][:] = True
    assert all((transition[1] != 77.0).all() and not transition[2].any() for transition in transitions[1:])
    assert all((info["agent_rewards"] != 77.0).all() for info in step[3])


def test_one_agent_has_no_others():
    splitter = TransitionSplitter(["solo"], {"solo": spaces.Discrete(2)})
    info = {
        "agent_rewards": np.ones(1, np.float32),
        "visible": np.zeros((1, 0), bool),
        **{key: np.zeros(1, bool) for key in ("active", "life_end", "truncated")},
    }
    (transition,) = splitter.split(
        {"solo": np.zeros(1, int)}, ({"solo": np.zeros((1, 1))}, np.zeros(1), np.zeros(1, bool), [info])
    )
    assert transition[3][0]["others_actions"].shape == (0,) and transition[3][0]["others_visible"].shape == (0,)


def test_many_agents_stay_cheap():
    """
    Guard against a loop over agents, copies and others.

    Measuring is left to the benchmarks, so the bound is ten times the usual 0.2 ms.
    """
    n, e = 10, 32
    names = [f"a{i}" for i in range(n)]
    splitter = TransitionSplitter(names, {name: spaces.Discrete(2) for name in names})
    info = {"agent_rewards": np.zeros(n, np.float32), "visible": np.ones((n, n - 1), bool)}
    info |= {key: np.zeros(n, bool) for key in ("active", "life_end", "truncated")}
    actions = {name: np.zeros(e, int) for name in names}
    step = ({name: np.zeros((e, 4)) for name in names}, np.zeros(e), np.zeros(e, bool), [dict(info) for _ in range(e)])
    times = []
    for _ in range(50):
        start = time.perf_counter()
        splitter.split(actions, step)
        times.append(time.perf_counter() - start)
    assert min(times) < 2e-3
