"""The global state for joint learners, and the masks after an episode's last step."""

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import DQN

from sb3_belief import BeliefPPO, MaskableBeliefPPO
from sb3_belief.common.action_masks import sample_action
from sb3_belief.envs import check_team_env
from sb3_belief.team.partners.vec_env import PartnersVecEnv
from tests.team.helpers import Team, make_team_env, parameters
from tests.team.toy_envs import FaultyEnv, MaskedEnv, ScriptedEnv, ToyEnv

BOTH = pytest.mark.parametrize("vec_env", ["dummy", "subproc"])


class StatefulEnv(ToyEnv):
    """
    A ``ToyEnv`` whose state is the step, the episode and the positions, each times ``scale``.

    :param scale: Changes the state and nothing else
    """

    def __init__(self, scale: float = 1.0, **kwargs):
        super().__init__(**kwargs)
        self.scale, self.episode, self.asked = scale, 0, 0

    def reset(self, seed=None, options=None):
        self.episode += 1
        return super().reset(seed, options)

    def state(self):
        self.asked += 1
        return self.scale * np.concatenate([[self.t, self.episode], *self.positions.values()])


class MaskedState(StatefulEnv, MaskedEnv):
    """A ``MaskedEnv`` with a state."""


def still(env):
    """Return the middle action of every agent."""
    return {agent: np.ones(env.num_envs, dtype=int) for agent in env.possible_agents}


@BOTH
def test_the_state_of_the_environment(vec_env):
    env = make_team_env(StatefulEnv, n_envs=2, seed=0, vec_env=vec_env)
    assert (env.state_source, env.state_space) == ("env", spaces.Box(-np.inf, np.inf, (6,), np.float32))
    obs = env.reset()
    states = env.states()
    assert states.dtype == np.float32 and states[:, 0].tolist() == [0, 0]
    assert np.array_equal(states[:, 2:], np.concatenate([obs["agent_0"], obs["agent_1"]], axis=1))
    for t in range(1, 15):
        obs, _, dones, infos = env.step(still(env))
        after = env.states()
        assert after is not states and after[:, 0].tolist() == [t % 7] * 2
        assert np.array_equal(after[:, 2:], np.concatenate([obs["agent_0"], obs["agent_1"]], axis=1))
        assert all("team_state" not in info for info in infos)
        for info in infos:
            assert ("terminal_state" in info) == dones[0] == (t % 7 == 0)
            if dones[0]:
                assert info["terminal_state"][0] == 7
                last = np.concatenate(list(info["terminal_observation"].values()))
                assert np.array_equal(info["terminal_state"][2:], last)
        states = after
    env.close()


@BOTH
def test_without_a_state_the_observations_are_it(vec_env):
    env = make_team_env(ScriptedEnv, n_envs=2, vec_env=vec_env)
    assert env.state_source == "observations" and env.state_space.shape == (8,)
    with pytest.raises(RuntimeError, match="before the first reset"):
        env.states()
    env.reset()
    assert env.states().tolist() == [[0, 10] * 4] * 2
    for _ in range(8):
        _, _, dones, infos = env.step({agent: np.zeros(2, int) for agent in env.possible_agents})
    assert dones.all()
    # Who left before the end observes zeros
    assert [info["terminal_state"].tolist() for info in infos] == [[8, 10, 0, 0, 0, 0, 8, 10]] * 2
    assert env.states().tolist() == [[0, 20] * 4] * 2
    env.close()


def test_discrete_observations_and_dicts_are_flattened():
    class Mixed(ToyEnv):
        def observation_space(self, agent):
            if agent == "agent_0":
                return spaces.Discrete(3)
            return spaces.Dict({"a": spaces.Box(0, 9, (2,), np.float32), "b": spaces.MultiDiscrete([2, 3])})

        def observations(self):
            return {"agent_0": self.t % 3, "agent_1": {"a": np.full(2, self.t, np.float32), "b": np.array([self.t % 2, 1])}}

    env = make_team_env(Mixed, n_envs=1)
    env.reset()
    env.step(still(env))
    assert env.states().tolist() == [[0, 1, 0, 1, 1, 0, 1, 0, 1, 0]]
    assert env.states()[0] in env.state_space
    for _ in range(6):
        _, _, _, infos = env.step(still(env))
    assert infos[0]["terminal_state"].tolist() == [0, 1, 0, 7, 7, 0, 1, 0, 1, 0]


@BOTH
def test_nothing_is_computed_before_it_is_asked_for(vec_env):
    env = make_team_env(StatefulEnv, n_envs=1, vec_env=vec_env)
    env.reset()
    for _ in range(8):
        _, _, _, infos = env.step(still(env))
        assert not {"terminal_state", "team_state"} & infos[0].keys()
    assert env.get_attr("asked") == [0]
    env.close()


@BOTH
def test_masks_after_the_last_step(vec_env):
    env = make_team_env(MaskedEnv, n_envs=2, vec_env=vec_env, env_kwargs={"n_agents": 3})
    env.reset()
    for t in range(7):
        actions = {f"agent_{i}": np.full(2, (t + i) % 3) for i in range(3)}
        _, _, dones, infos = env.step(actions)
        assert all(("terminal_action_masks" in info) == dones[0] == (t == 6) for info in infos)
    for info in infos:
        # Step 7 of the old episode, not step 0 of the next
        assert [info["terminal_action_masks"][f"agent_{i}"].tolist() for i in range(3)] == [
            [False, True, False],
            [False, False, True],
            [True, True, True],
        ]
    assert env.action_masks()["agent_0"].tolist() == [[True, False, False]] * 2
    env.close()


def test_a_last_mask_that_allows_nothing_allows_the_first_action():
    class Ends(ToyEnv):
        def infos(self):
            return {agent: {"action_mask": np.full(3, self.t < self.limit)} for agent in self.agents}

    env = make_team_env(Ends)
    env.reset()
    for _ in range(7):
        _, _, _, infos = env.step(still(env))
    assert infos[0]["terminal_action_masks"]["agent_1"].tolist() == [True, False, False]


@pytest.mark.parametrize(
    "env_id",
    ["traffic-junction-easy", "traffic-junction-medium", "junction-cultures-easy", "convention-swap", "aisle-sides"],
)
def test_batched_copies_say_the_same_as_single_ones(env_id):
    envs = [make_team_env(env_id, n_envs=2, seed=3, wrapper=wrapper) for wrapper in (None, lambda env: env)]
    batched, single = envs
    assert type(batched) is not type(single)
    for env in envs:
        env.reset()
    rng, ended = np.random.default_rng(0), 0
    assert batched.state_space == single.state_space and batched.state_source == single.state_source
    for _ in range(150):
        assert np.array_equal(batched.states(), single.states())
        masks = batched.action_masks()
        actions = {
            agent: np.array([sample_action(batched.action_space[agent], masks and masks[agent][e], rng) for e in range(2)])
            for agent in batched.possible_agents
        }
        (_, _, dones, infos), (_, _, _, others) = (env.step(actions) for env in envs)
        for copy in np.flatnonzero(dones):
            ended += 1
            assert np.array_equal(infos[copy]["terminal_state"], others[copy]["terminal_state"])
            for agent in batched.possible_agents if masks else ():
                own, other = (each[copy]["terminal_action_masks"][agent] for each in (infos, others))
                assert own.shape == masks[agent][0].shape and np.array_equal(own, other)
    assert ended


@BOTH
def test_an_episode_that_breaks_off_ends_in_its_last_state(vec_env):
    class Breaks(MaskedState, FaultyEnv):
        pass

    env = make_team_env(Breaks, env_kwargs={"fault": "raise"}, vec_env=vec_env, restart_workers=1)
    env.reset()
    env.states()
    for t in range(9):
        env.step({"agent_0": np.array([t % 7 % 3]), "agent_1": np.array([1])})
    before, masks = env.states(), env.action_masks()["agent_0"]
    with pytest.warns(RuntimeWarning, match="made anew"):
        _, _, dones, infos = env.step({"agent_0": np.array([2]), "agent_1": np.array([1])})
    assert dones[0] and infos[0]["worker_restarted"]
    assert infos[0]["terminal_state"].tolist() == before[0].tolist() and before[0, 0] == 2
    assert infos[0]["terminal_action_masks"]["agent_0"].tolist() == masks[0].tolist() == [False, False, True]
    assert env.states()[0, 0] == 0
    env.step({"agent_0": np.array([0]), "agent_1": np.array([1])})
    assert env.states()[0, 0] == 1
    env.close()


def test_wrappers_and_partners_say_the_state_of_the_environment_within():
    last = make_team_env(StatefulEnv, n_envs=2, seed=0, observe_last=True)
    within = make_team_env(StatefulEnv, n_envs=2, seed=0, env_kwargs={"n_agents": 3})
    partnered = PartnersVecEnv(within, {"agent_1": lambda obs: np.array(1)})
    for env, width in ((last, 6), (partnered, 8)):
        assert env.state_source == "env" and env.state_space.shape == (width,)
        env.reset()
        for _ in range(7):
            assert env.states().shape == (2, width)
            _, _, dones, infos = env.step(still(env))
        assert dones.all() and infos[0]["terminal_state"][0] == 7
    # The masks of partners are not among those of the learners
    masked = PartnersVecEnv(make_team_env(MaskedEnv, env_kwargs={"n_agents": 3}), {"agent_2": lambda obs: np.array(1)})
    masked.reset()
    for t in range(7):
        _, _, _, infos = masked.step({f"agent_{i}": np.array([(t + i) % 3]) for i in range(2)})
    assert list(infos[0]["terminal_action_masks"]) == ["agent_0", "agent_1"]


@pytest.mark.parametrize("at", [3, 6])
@pytest.mark.parametrize("env", [StatefulEnv, ToyEnv, "traffic-junction-easy"])
def test_states_after_an_exact_resume(env, at):
    rng = np.random.default_rng(0)
    first, second = (make_team_env(env, n_envs=2, seed=seed) for seed in (0, 7))
    actions = [{agent: rng.integers(0, 2, 2) for agent in first.possible_agents} for _ in range(8)]
    if env == "traffic-junction-easy":
        actions = [{agent: np.ones(2, int) for agent in first.possible_agents}] * 8
    first.reset(), second.reset()
    first.states()
    for each in actions[:at]:
        first.step(each)
    second.set_exact_state(first.exact_state())
    for each in actions[at:]:
        # The first step may end an episode before anybody has asked again
        (_, _, dones, infos), (_, _, _, others) = (each_env.step(each) for each_env in (first, second))
        assert np.array_equal(first.states(), second.states())
        if dones[0]:
            assert np.array_equal(infos[0]["terminal_state"], others[0]["terminal_state"])


@pytest.mark.parametrize("algorithm", [BeliefPPO, DQN])
def test_no_agent_of_a_team_sees_the_state(algorithm):
    kwargs = {"n_steps": 16, "batch_size": 16} if algorithm is BeliefPPO else {"learning_starts": 10, "train_freq": 4}
    policy = "BeliefPolicy" if algorithm is BeliefPPO else "MlpPolicy"
    learned = []
    for scale, asks in ((1.0, False), (1.0, True), (-50.0, True)):
        env = make_team_env(StatefulEnv, n_envs=2, seed=0, env_kwargs={"scale": scale})
        if asks:
            # From here on the team's infos hold the state
            env.reset()
            env.states()
        team = Team(algorithm, policy, env, seed=0, **kwargs)
        seen: list[Any] = []

        def keep(locals_, globals_, seen=seen):
            seen.extend(info.keys() for info in locals_["infos"])
            return True

        team.learn(64, agent_callbacks={"agent_0": keep})
        assert seen and not {"terminal_state", "team_state"} & set().union(*seen)
        assert any("terminal_observation" in keys for keys in seen)
        learned.append([parameters(model) for model in team.agents.values()])
    for others in learned[1:]:
        assert all(bool((a == b).all()) for a, b in zip(learned[0], others, strict=True))


def test_an_agent_gets_its_own_last_mask():
    class Ends(ToyEnv):
        def infos(self):
            return {agent: {"action_mask": np.arange(3) <= self.t % 3 + (agent == "agent_0")} for agent in self.agents}

    team = Team(MaskableBeliefPPO, "BeliefPolicy", make_team_env(Ends), seed=0, n_steps=14, batch_size=14)
    last: dict[str, list[Any]] = {agent: [] for agent in team.agents}

    def keeper(agent):
        def keep(locals_, globals_):
            last[agent] += [info.get("terminal_action_masks") for info in locals_["infos"] if locals_["dones"][0]]
            return True

        return keep

    team.learn(14, agent_callbacks={agent: keeper(agent) for agent in team.agents})
    # Step 7 of both episodes
    assert [mask.tolist() for mask in last["agent_0"]] == [[True, True, True]] * 2
    assert [mask.tolist() for mask in last["agent_1"]] == [[True, True, False]] * 2


@pytest.mark.parametrize(
    ("state", "message"),
    [
        (lambda env: {"t": env.t}, "returned a dict in environment copy 0 at step 1"),
        (lambda env: np.full(2, np.nan), "holds nan"),
        (lambda env: np.zeros(1 + env.t), "has 2 entries, and had 1"),
    ],
)
def test_a_state_that_is_none(state, message):
    class Wrong(ToyEnv):
        state_space = spaces.Box(-1, 1, (1,))

        def state(self):
            return state(self) if self.t else np.zeros(1)

    env = make_team_env(Wrong)
    env.reset()
    env.states()
    with pytest.raises(ValueError, match=message):
        env.step(still(env))


def test_a_state_that_is_not_implemented_is_none():
    class Template(ToyEnv):
        def state(self):
            raise NotImplementedError

    env = make_team_env(Template)
    assert env.state_source == "observations"
    env.reset()
    assert env.states().shape == (1, 4)


@pytest.mark.parametrize(
    ("env", "verdict", "text"),
    [
        (ToyEnv, "note", "no state(): joint learners are given all observations, 4 numbers"),
        ("mpe/simple_spread_v3", "ok", "state() gives 54 numbers, for joint learners alone"),
    ],
)
def test_the_checker_says_what_the_state_is(env, verdict, text):
    (found,) = [finding for finding in check_team_env(env, n_steps=30).findings if finding.topic == "global state"]
    assert (found.verdict, found.text) == (verdict, text)


@pytest.mark.parametrize(
    ("state", "text"),
    [
        (lambda env: {"t": env.t}, "it must return an array of numbers"),
        (lambda env: np.array([np.inf]), "it must be finite"),
        (lambda env: np.zeros(1 + env.t % 2), "different steps"),
        (lambda env: np.random.default_rng().normal(size=2), "differs after two resets"),
    ],
)
def test_the_checker_finds_faults_of_the_state(state, text):
    class Wrong(ToyEnv):
        def state(self):
            return state(self)

    (found,) = [finding for finding in check_team_env(Wrong, n_steps=30).failures if finding.topic == "global state"]
    assert text in found.text and "Change:" in found.text
