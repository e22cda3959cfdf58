"""Environments that return the unusual: what is clear is taken as it is meant, the rest refused with agent, copy and step."""

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from pettingzoo.utils.wrappers import BaseParallelWrapper

from sb3_belief import BeliefPPO
from tests.field.unusual import CLEAR, Duck, ListsOfOne, OldStep, Positional, Sets
from tests.field.walkers import Walkers, play
from tests.team.helpers import PPO_KWARGS, Team, make_team_env


@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
@pytest.mark.filterwarnings("error::DeprecationWarning")
def test_what_is_clear_is_taken_as_it_is_meant(vec_env):
    usual = play(make_team_env(Walkers, n_envs=2), 6)
    for unusual in CLEAR if vec_env == "dummy" else [ListsOfOne, Sets, Duck]:
        env = make_team_env(unusual, n_envs=2, vec_env=vec_env)
        for (obs, rewards, dones, infos), (obs_, rewards_, dones_, infos_) in zip(play(env, 6), usual, strict=True):
            assert rewards.tolist() == rewards_.tolist() and dones.tolist() == dones_.tolist(), unusual
            assert all(np.array_equal(obs[agent], obs_[agent]) for agent in obs_), unusual
            for key in ("agent_rewards", "active", "life_end", "truncated", "visible"):
                assert np.array_equal(infos[1][key], infos_[1][key]), (unusual, key)
            assert infos[1].get("TimeLimit.truncated") == infos_[1].get("TimeLimit.truncated"), unusual
        env.close()


def test_a_done_of_the_old_interface_is_a_termination_unless_the_info_says_otherwise():
    class Done(OldStep):
        def change(self, *parts):
            return (*super().change(*parts)[:3], {})

    *_, (_, _, dones, infos) = play(make_team_env(Done), 4)
    assert dones.all() and infos[0]["life_end"].all() and infos[0]["TimeLimit.truncated"] is False


def test_an_environment_without_seeds_says_so_once():
    env = make_team_env(Positional, seed=3)
    with pytest.warns(UserWarning, match=r"Positional cannot be seeded: its reset\(\) has no argument seed"):
        env.reset()
    env.set_options({"size": 3})
    with pytest.raises(ValueError, match=r"Positional takes no options: its reset\(\) has no such argument, got {'size': 3}"):
        env.reset()


def test_an_old_environment_is_seeded_by_its_method():
    class Seeded(Positional):
        def seed(self, seed=None):
            self.seeded = seed

    env = make_team_env(Seeded, n_envs=2, seed=3)
    env.reset()
    assert env.get_attr("seeded") == [3, 4]


@pytest.mark.parametrize(
    "obs_space, act_space",
    [
        (spaces.Box(-1e6, 1e6, (), np.float32), spaces.Discrete(3)),
        (spaces.MultiDiscrete(np.array([[2, 3], [4, 5]])), spaces.MultiDiscrete(np.array([[2, 3], [4, 2]]))),
        (spaces.Box(0, 1, (2,), np.float32), spaces.MultiBinary((2, 2))),
        (spaces.Discrete(3), spaces.Box(-1, 1, (), np.float32)),
    ],
)
def test_spaces_of_a_shape_that_no_model_takes(obs_space, act_space):
    """Models get them flat, the environment in its own shape."""

    class Shaped(Walkers):
        def observe(self, agent):
            return np.full(obs_space.shape, 0.5 if isinstance(obs_space, spaces.Box) else 1, obs_space.dtype)

        def step(self, actions):
            assert all(np.shape(action) == act_space.shape for action in actions.values())
            assert all(act_space.contains(np.asarray(action, act_space.dtype)) for action in actions.values())
            return super().step(actions)

    Shaped.obs_space, Shaped.act_space = obs_space, act_space
    env = make_team_env(Shaped, n_envs=2)
    if not isinstance(obs_space, spaces.Discrete):
        assert env.reset()["walker_1"].shape == (2, max(1, int(np.prod(obs_space.shape))))
    Team(BeliefPPO, "BeliefPolicy", env, seed=0, **PPO_KWARGS).learn(16)


def test_bounds_that_no_model_can_act_in():
    class Unbounded(Walkers):
        act_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)

    with pytest.raises(ValueError, match=r"The action space of 'walker_0' is Box.*, without finite bounds.* give it bounds"):
        make_team_env(Unbounded)


class Wrong(Walkers):
    """One fault at step 2."""

    fault: Any = None

    def change(self, *parts):
        return self.fault(*parts) if self.t == 2 else parts


WHERE = "in environment copy 0 at step 2"
FAULTS: dict[str, tuple[Any, str]] = {
    "vector": (lambda o, r, *x: (o, {a: np.ones(2) for a in r}, *x), f"The reward of 'walker_0' {WHERE} is array"),
    "vector of one": (lambda o, r, *x: (o, {**r, "walker_1": [1, 2]}, *x), f"The reward of 'walker_1' {WHERE} is [1, 2]"),
    "text": (lambda o, r, *x: (o, {**r, "walker_1": "much"}, *x), f"The reward of 'walker_1' {WHERE} is 'much'"),
    "none": (lambda o, r, *x: (o, dict.fromkeys(r), *x), f"The reward of 'walker_0' {WHERE} is None"),
    "complex": (lambda o, r, *x: (o, dict.fromkeys(r, 1j), *x), f"The reward of 'walker_0' {WHERE} is 1j"),
    "large": (lambda o, r, *x: (o, dict.fromkeys(r, 1e300), *x), f"The reward of 'walker_0' {WHERE} holds inf"),
    "no rewards": (lambda o, r, *x: (o, None, *x), f"The environment's rewards {WHERE} are None"),
    "no observations": (lambda o, *x: (None, *x), f"The environment's observations {WHERE} are None"),
    "list": (lambda o, *x: (list(o.values()), *x), f"The environment's observations {WHERE} are a list of 2"),
    "three parts": (lambda *x: x[:3], f"step() returned a tuple of 3 {WHERE}"),
    "no infos": (
        lambda o, r, te, tr, i: (o, r, te, dict.fromkeys(tr, True)),
        f"step() returned a tuple of 4 {WHERE}",
    ),
    "nothing": (lambda *x: None, f"step() returned None {WHERE}"),
    "info": (lambda *x: (*x[:4], {"walker_1": [3]}), f"The info of 'walker_1' {WHERE} is a list of 1"),
    "flags": (
        lambda o, r, te, tr, i: (o, r, {a: np.zeros(2, bool) for a in te}, tr, i),
        f"The terminations have array([False, False]) for 'walker_0' {WHERE}",
    ),
    "ragged": (
        lambda o, *x: ({**o, "walker_1": [[1, 2], [3]]}, *x),
        f"The observation of 'walker_1' {WHERE} has the shape (2,) and type object",
    ),
    "float64": (
        lambda o, *x: ({**o, "walker_1": np.full(3, 1e300)}, *x),
        f"The observation of 'walker_1' {WHERE} holds inf",
    ),
}


@pytest.mark.parametrize("fault, message", FAULTS.values(), ids=FAULTS)
@pytest.mark.filterwarnings("ignore:overflow")
def test_what_is_not_clear_is_one_error(fault, message):
    class Faulty(Wrong):
        pass

    Faulty.fault = staticmethod(fault)
    with pytest.raises(ValueError) as error:
        play(make_team_env(Faulty), 3)
    assert str(error.value).startswith(message)


RESETS: dict[str, tuple[Any, str]] = {
    "three": (lambda obs, infos: (obs, infos, {}), r"reset\(\) returned a tuple of 3 in environment copy 0 at reset"),
    "none": (lambda obs, infos: None, r"reset\(\) returned None in environment copy 0 at reset"),
    "list": (lambda obs, infos: ([1], infos), "observations in environment copy 0 at reset are a list of 1"),
    "float64": (
        lambda obs, infos: ({**obs, "walker_1": np.full(3, 1e300)}, infos),
        "The observation of 'walker_1' in environment copy 0 at reset holds inf",
    ),
}


@pytest.mark.parametrize("fault, message", RESETS.values(), ids=RESETS)
def test_a_reset_that_is_not_clear_is_one_error(fault, message):
    class Faulty(Walkers):
        def reset(self, seed=None, options=None):
            return fault(*super().reset())

    with pytest.raises(ValueError, match=message):
        make_team_env(Faulty).reset()


def test_a_reset_that_brings_nobody_into_play():
    class Empty(Walkers):
        def reset(self, seed=None, options=None):
            result = super().reset()
            self.agents = []
            return result

    class Without(Duck):
        agents = property(lambda self: self.nobody)

    for kind in (Empty, Without):
        with pytest.raises(ValueError, match=r"agents is empty in environment copy 0 at reset: reset\(\) must fill it"):
            make_team_env(kind).reset()


@pytest.mark.parametrize("at_reset", [True, False])
def test_observations_that_are_no_choice(at_reset):
    """A network would fail on them, with an error of its own."""

    class Choices(Walkers):
        obs_space = spaces.Discrete(3)

        def observe(self, agent):
            return 3 if (self.t == 0) == at_reset and agent == "walker_1" else 2

    where = "at reset" if at_reset else "at step 1"
    with pytest.raises(ValueError, match=f"The observation of 'walker_1' in environment copy 0 {where} is 3, which is not in"):
        play(make_team_env(Choices), 1)


@pytest.mark.parametrize(
    "reward, message", [(np.ones(2), "is array"), (float("nan"), "holds nan"), ("all", "is 'all'"), ([2.0], None)]
)
def test_a_team_reward_of_its_own(reward, message):
    class Paid(Walkers):
        def team_reward(self, rewards):
            return reward

    env = make_team_env(Paid)
    if message is None:
        assert play(env, 1)[0][1].tolist() == [2.0]
    else:
        with pytest.raises(ValueError, match=f"The team's reward in environment copy 0 at step 1 {message}"):
            play(env, 1)


class Impostor:
    """Has some of the interface."""

    possible_agents = ("a",)

    def reset(self, seed=None, options=None): ...


def test_what_is_no_environment_of_a_team():
    with pytest.raises(TypeError, match=r"got Impostor \(which has no step, observation_space, action_space\)"):
        make_team_env(Impostor)
    with pytest.raises(TypeError, match="pass the class, or a function"):
        make_team_env(Duck())

    class NoSpaces(Walkers):
        def observation_space(self, agent):
            raise KeyError("no such thing")

    with pytest.raises(ValueError, match=r"The spaces of 'walker_0' are not known, even after a reset\(\): KeyError"):
        make_team_env(NoSpaces)
    NoSpaces.observation_space = lambda self, agent: 4  # type: ignore[method-assign]
    with pytest.raises(ValueError, match=r"observation_space\('walker_0'\).* must return gymnasium spaces, got int and Disc"):
        make_team_env(NoSpaces)


def test_an_environments_own_error_says_where_it_happened():
    class Broken(Walkers):
        def step(self, actions):
            raise ArithmeticError("broken")

    with pytest.raises(ArithmeticError, match="broken") as error:
        play(make_team_env(Broken, n_envs=2), 1)
    assert error.value.__notes__ == ["Raised by the environment's step() in environment copy 0 at step 1."]


def test_wrappers_around_the_unusual():
    env = make_team_env(ListsOfOne, wrapper=BaseParallelWrapper)
    assert play(env, 1)[0][3][0]["agent_rewards"].tolist() == [1.0, 2.0]
