"""Observations that hold the last step hold what info says of it, and nothing else."""

from functools import partial
from typing import Any, ClassVar

import numpy as np
import pytest
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sb3_belief.common.plain_data import encode
from sb3_belief.vec_env.agent_vec_env import TransitionSplitter
from sb3_belief.vec_env.observation_forms import as_bytes, row_of
from sb3_belief.vec_env.observe_last import LastStepForm
from tests.team.guest_env import GuestEnv
from tests.team.helpers import make_team_env
from tests.team.toy_envs import BlinkingEnv, MixedEnv, PartneredEnv, ScriptedEnv, ToyEnv

ENVS = {
    "spaces of every kind": MixedEnv,
    "every kind of end": ScriptedEnv,
    "scripted others": PartneredEnv,
    "seen at times": BlinkingEnv,
    "batched, with lives that end": "traffic-junction-easy",
    "batched, Discrete": "convention-swap",
}


def sampled(env, rng):
    """Return random actions of all agents."""
    actions = {}
    for agent in env.possible_agents:
        space = env.action_space[agent]
        space.seed(int(rng.integers(2**31)))
        actions[agent] = np.stack([np.asarray(space.sample()) for _ in range(env.num_envs)])
    return actions


def expected_last(env, agent, own, action, copy):
    """Return the last step of a copy as the documentation describes it, from what reaches the agent's info."""
    active = own.active[copy]
    encoded = np.asarray(spaces.flatten(env.action_space[agent], action)).astype(np.float32)
    return np.concatenate(
        [
            own.others_actions[copy],
            own.others_visible[copy].astype(np.float32),
            encoded if active else np.zeros_like(encoded),
            own.rewards[copy : copy + 1],
        ]
    )


@pytest.mark.parametrize("make", ENVS.values(), ids=ENVS.keys())
def test_holds_what_info_says_and_zeros_at_the_start_of_an_episode(make):
    plain, env = (make_team_env(make, n_envs=3, seed=5, observe_last=last) for last in (False, True))
    splitter = TransitionSplitter(
        plain.possible_agents, {a: plain.action_space[a] for a in plain.possible_agents}, plain.scripted_action_spaces
    )
    rng = np.random.default_rng(0)
    own_obs, obs = plain.reset(), env.reset()
    lasts: dict[str, list] = {}
    ends = 0
    for t in range(30):
        actions = sampled(plain, rng)
        for agent in plain.possible_agents:
            for copy in range(3):
                flat = np.asarray(spaces.flatten(plain.observation_space[agent], row_of(own_obs[agent], copy)))
                last = lasts[agent][copy] if t else np.zeros(obs[agent].shape[1] - flat.size)
                assert obs[agent][copy].tobytes() == np.concatenate([flat, last]).astype(np.float32).tobytes()
                assert env.observation_space[agent].contains(obs[agent][copy])
        step, other = plain.step(actions), env.step(actions)
        for mine, theirs in zip(step[1:3], other[1:3], strict=True):
            np.testing.assert_array_equal(mine, theirs)
        own_obs, obs = step[0], other[0]
        for agent, own, seen in zip(
            plain.possible_agents, splitter.transitions(actions, step), splitter.transitions(actions, other), strict=True
        ):
            lasts[agent] = [expected_last(plain, agent, own, actions[agent][copy], copy) for copy in range(3)]
            assert own.ends.keys() == seen.ends.keys()
            for copy, end in own.ends.items():
                ends += 1
                flat = np.asarray(spaces.flatten(plain.observation_space[agent], end["terminal_observation"]))
                joined = np.concatenate([flat, lasts[agent][copy]]).astype(np.float32)
                assert seen.ends[copy]["terminal_observation"].tobytes() == joined.tobytes()
                assert seen.ends[copy]["TimeLimit.truncated"] == end["TimeLimit.truncated"]
                lasts[agent][copy] = np.zeros_like(lasts[agent][copy])
    assert ends
    plain.close()
    env.close()


def test_the_actions_of_who_is_not_seen_change_nothing():
    env = make_team_env(ToyEnv, seed=3, observe_last=True, visibility=lambda env: {"agent_1": np.array([True])})
    seen = []
    for unseen in (0, 2):
        env.seed(3)
        obs, rows = env.reset(), []
        for _ in range(20):
            rows.append({agent: row.copy() for agent, row in obs.items()})
            obs = env.step({"agent_0": np.array([1]), "agent_1": np.array([unseen])})[0]
        seen.append(rows)
    assert [row["agent_0"].tobytes() for row in seen[0]] == [row["agent_0"].tobytes() for row in seen[1]]
    assert [row["agent_1"].tobytes() for row in seen[0]] != [row["agent_1"].tobytes() for row in seen[1]]


def test_only_those_who_are_named_observe_it():
    env = make_team_env(ToyEnv, observe_last=["agent_1"])
    assert [env.observation_space[agent].shape for agent in env.possible_agents] == [(2,), (2 + 3 + 1 + 3 + 1,)]


class Forms(ParallelEnv):
    """An environment whose agents observe an image, and a Dict."""

    metadata: ClassVar[dict[str, Any]] = {"name": "forms"}
    render_mode = None

    def __init__(self, name: str = "place"):
        self.possible_agents = ["eye", "dict"]
        self.agents: list[str] = []
        image = spaces.Box(0, 255, (36, 36, 1), np.uint8)
        self.seen = {"eye": image, "dict": spaces.Dict({name: spaces.Discrete(3), "map": image})}

    def observation_space(self, agent):
        return self.seen[agent]

    def action_space(self, agent):
        return spaces.Discrete(2)

    def reset(self, seed=None, options=None):
        self.agents = self.possible_agents[:]
        return {agent: space.sample() for agent, space in self.seen.items()}, {agent: {} for agent in self.agents}

    def step(self, actions):
        flags = dict.fromkeys(self.agents, False)
        return self.reset()[0], dict.fromkeys(self.agents, 2.0), flags, flags, {}


def test_images_become_a_dict_and_a_dict_gets_an_entry():
    env = make_team_env(Forms, n_envs=2, seed=0, observe_last=True)
    assert list(env.observation_space["eye"].spaces) == ["last_step", "observation"]
    assert set(env.observation_space["dict"].spaces) == {"place", "map", "last_step"}
    env.reset()
    obs = env.step({"eye": np.array([0, 1]), "dict": np.array([1, 1])})[0]
    assert obs["eye"]["observation"].dtype == np.uint8 and obs["eye"]["observation"].shape == (2, 36, 36, 1)
    # What "dict" did, that it was seen, what "eye" did itself, its reward
    np.testing.assert_array_equal(obs["eye"]["last_step"], [[0, 1, 1, 1, 0, 2], [0, 1, 1, 0, 1, 2]])
    np.testing.assert_array_equal(obs["dict"]["last_step"][:, :2], [[1, 0], [0, 1]])
    with pytest.raises(ValueError, match=r"'last_step' already.*rename"):
        make_team_env(partial(Forms, "last_step"), observe_last=True)


def test_an_action_that_was_ignored_leaves_no_nan():
    form = LastStepForm("a", spaces.Discrete(2), spaces.Box(-1, 1, (1,)), {}, last=True, starts=False)
    one = np.ones(1, dtype=bool)
    row = form.last_step(np.zeros((1, 0)), np.zeros((1, 0), bool), ~one, np.array([[np.nan]]), np.ones(1))
    assert row.tolist() == [[0.0, 1.0]]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"observe_last": ["nobody"]}, "observe_last has the unknown agents"),
        ({"observe_last": "agent_0"}, "observe_last='agent_0' must be True"),
        ({"partner_starts": ["nobody"]}, "partner_starts has the unknown agents"),
        ({"partner_starts": True}, "says which partner is there"),
    ],
)
def test_refused(given, message):
    with pytest.raises(ValueError, match=message):
        make_team_env(ToyEnv, **given)


# Where another partner has come


@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_the_memory_starts_where_another_partner_has_come(vec_env):
    env = make_team_env(GuestEnv, n_envs=4, seed=0, observe_last=True, partner_starts=True, vec_env=vec_env)
    obs = env.reset()["guest"]
    np.testing.assert_array_equal(obs["memory_start"], 1)
    names, met = env.get_attr("partner"), 0
    for t in range(1, 81):
        obs, _, dones, infos = env.step({"guest": np.full(4, t % 2)})
        obs, before, names = obs["guest"], names, env.get_attr("partner")
        starts = [old != new for old, new in zip(before, names, strict=True)]
        np.testing.assert_array_equal(obs["memory_start"][:, 0], starts)
        assert dones.all() == (t % 2 == 0)
        # Kept over the ends of episodes, and gone with the partner: what it did itself is never zero otherwise
        np.testing.assert_array_equal(obs["observation"][:, -3:-1].any(axis=1), np.logical_not(starts))
        for done, info in zip(dones, infos, strict=True):
            if done:
                last = info["terminal_observation"]["guest"]
                assert last["memory_start"] == 0 and last["observation"][-3:-1].any()
        met += sum(starts)
    assert 4 < met < 4 * 10
    env.close()


def test_the_flag_alone():
    env = make_team_env(GuestEnv, partner_starts=["guest"])
    assert set(env.observation_space["guest"].spaces) == {"observation", "memory_start"}
    assert env.reset()["guest"]["observation"].shape == (1, 2)


@pytest.mark.parametrize("make", [GuestEnv, "traffic-junction-easy"])
def test_the_exact_state_goes_on_alike(make):
    given: dict[str, Any] = {"n_envs": 3, "seed": 1, "observe_last": True, "partner_starts": make is GuestEnv}
    env, other = make_team_env(make, **given), make_team_env(make, **given)
    rng = np.random.default_rng(1)
    env.reset()
    other.reset()
    for _ in range(7):
        env.step(sampled(env, rng))
    state = env.exact_state()
    encode(state, lambda module: True)
    other.set_exact_state(state)
    for _ in range(60):
        actions = sampled(env, rng)
        (obs, rewards, dones, _), theirs = env.step(actions), other.step(actions)
        np.testing.assert_array_equal(rewards, theirs[1])
        np.testing.assert_array_equal(dones, theirs[2])
        assert {a: as_bytes(o) for a, o in obs.items()} == {a: as_bytes(o) for a, o in theirs[0].items()}
