"""What is no mask, masks in further places and forms, and numbers that a cast would change."""

import threading
from enum import Enum
from functools import partial
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO

from sb3_belief.envs import check_team_env, to_parallel
from tests.field.walkers import Walkers, play
from tests.team.helpers import PPO_KWARGS, Team, make_team_env

BOX: Any = spaces.Box(-1e6, 1e6, (3,), np.float32)
FLAGS = spaces.MultiBinary(3)
KWARGS: dict[str, Any] = {"n_steps": 8, "batch_size": 8, "n_epochs": 1, "device": "cpu"}


class Masked(Walkers):
    """
    Gives the same mask to each walker from some step on, in its info, in its observation or by a method.

    :param mask: The mask
    :param step: First step at which it is given; before, all is possible
    """

    way = "infos"

    def __init__(self, mask, step=0):
        super().__init__(limit=6)
        self.mask, self.step_of_mask = mask, step
        if self.way == "observation":
            self.obs_space = spaces.Dict({"seen": BOX, "action_mask": FLAGS})

    def now(self):
        return self.mask if self.t >= self.step_of_mask else np.ones(3, bool)

    def observe(self, agent):
        seen = super().observe(agent)
        return {"seen": seen, "action_mask": self.now()} if self.way == "observation" else seen

    def infos(self):
        return {agent: {"action_mask": self.now()} if self.way == "infos" else {} for agent in self.possible_agents}

    def reset(self, seed=None, options=None):
        obs, _ = super().reset()
        return obs, self.infos()

    def change(self, *parts):
        return (*parts[:4], self.infos())


class InObservation(Masked):
    way = "observation"


class ByMethod(Masked):
    way = "method"

    def action_masks(self):
        return dict.fromkeys(self.agents, self.now())


NO_MASKS = [
    [0, -np.inf, 0],
    np.array([0, 1, 2]),
    ["1", "0", "1"],
    [0.5, 0, 1],
    [None, True, False],
    np.array([np.nan, 1, 1]),
    "101",
]


@pytest.mark.parametrize("kind", [Masked, InObservation, ByMethod])
@pytest.mark.parametrize("mask", NO_MASKS, ids=str)
@pytest.mark.parametrize("step", [0, 1])
def test_what_is_no_mask(kind, mask, step):
    where = "in environment copy 0 at " + (f"step {step}" if step else "reset")
    with pytest.raises(ValueError, match=f"The action mask of 'walker_0' {where} holds .*: a mask consists of flags"):
        play(make_team_env(partial(kind, mask, step)), 2)
    if kind is InObservation and not step:
        with pytest.raises(ValueError, match="The action mask of 'walker_0' at reset holds"):
            to_parallel(InObservation(mask)).reset()


@pytest.mark.parametrize(
    "mask", [[0, 1, 0], np.array([0.0, 1.0, 0.0]), np.array([0, 1, 0], np.int8), (False, True, False)], ids=str
)
def test_what_is_a_mask(mask):
    env = make_team_env(partial(Masked, mask))
    env.reset()
    assert env.action_masks()["walker_1"].tolist() == [[False, True, False]]


class Two(Masked):
    act_space = spaces.MultiDiscrete([3, 2])


def test_a_mask_for_each_dimension():
    env = make_team_env(partial(Two, {"go": np.array([1, 0, 1]), "say": [True, False]}))
    env.reset()
    assert env.action_masks()["walker_0"].tolist() == [[True, False, True, True, False]]
    for parts in ({"say": [1, 0], "go": [1, 0, 1]}, ([1, 0], [1, 0, 1])):
        with pytest.raises(ValueError, match=r"'walker_0' in .* at reset has parts of \[2, 3\] flags, but .* of \[3, 2\]"):
            make_team_env(partial(Two, parts)).reset()


def test_masks_that_are_split_otherwise():
    class Board(Masked):
        act_space = spaces.Discrete(4)

    for make, row in ((partial(Board, [[1, 0], [0, 1]]), [1, 0, 0, 1]), (partial(Two, [[1, 0, 1, 1, 0]]), [1, 0, 1, 1, 0])):
        env = make_team_env(make)
        env.reset()
        assert env.action_masks()["walker_0"].tolist() == [[bool(flag) for flag in row]]


class Asked(Walkers):
    """Gives a mask to whom it is asked about."""

    def action_masks(self, agent):
        assert agent in self.agents
        return np.arange(3) != self.possible_agents.index(agent)


class AskedByNumber(Asked):
    def __init__(self):
        super().__init__()
        self.possible_agents = [7, 8]


class Held(Walkers):
    """Holds its masks as an attribute."""

    def __init__(self):
        super().__init__()
        self.action_masks = {agent: np.arange(3) != i for i, agent in enumerate(self.possible_agents)}


@pytest.mark.parametrize("kind", [Asked, AskedByNumber, Held])
@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_masks_of_the_environment(kind, vec_env):
    env = make_team_env(kind, vec_env=vec_env)
    play(env, 2)
    masks = [[[False, True, True]], [[True, False, True]]]
    assert [mask.tolist() for mask in env.action_masks().values()] == masks
    Team(MaskablePPO, "MlpPolicy", env, **KWARGS).learn(8)
    assert check_team_env(kind, n_steps=20).failures == []
    env.close()


def test_masks_of_unknown_agents():
    class Unknown(Walkers):
        def action_masks(self):
            return {"walker_0": [1, 1, 1], "runner": [1, 1, 1]}

    with pytest.raises(ValueError, match=r"action_masks have one for 'runner', which is not among its possible_agents"):
        make_team_env(Unknown).reset()


class Deep(Walkers):
    """
    Observes what a test puts together.

    :param space: Its observation space
    :param build: Returns an observation, of what a walker sees and its mask
    """

    def __init__(self, space, build):
        super().__init__()
        self.obs_space, self.build = space, build

    def observe(self, agent):
        return self.build(super().observe(agent), np.array([0, 1, 1], np.int8))


MASKED: Any = spaces.Dict({"seen": BOX, "action_mask": FLAGS})
DEEP: dict[str, tuple[spaces.Space, Any, spaces.Space]] = {
    "beside": (
        spaces.Dict({"own": MASKED, "goal": BOX}),
        lambda seen, mask: {"own": {"seen": seen, "action_mask": mask}, "goal": seen},
        spaces.Dict({"own": BOX, "goal": BOX}),
    ),
    "among": (
        spaces.Dict({"own": spaces.Dict({"seen": BOX, "map": BOX, "action_mask": FLAGS}), "goal": BOX}),
        lambda seen, mask: {"own": {"seen": seen, "map": seen, "action_mask": mask}, "goal": seen},
        spaces.Dict({"goal": BOX, "own/map": BOX, "own/seen": BOX}),
    ),
    "alone": (
        spaces.Dict({"seen": BOX, "legal": spaces.Dict({"action_mask": FLAGS})}),
        lambda seen, mask: {"seen": seen, "legal": {"action_mask": mask}},
        spaces.Dict({"seen": BOX}),
    ),
    "tuple": (
        spaces.Tuple([MASKED, BOX]),
        lambda seen, mask: ({"seen": seen, "action_mask": mask}, seen),
        spaces.Dict({"0": BOX, "1": BOX}),
    ),
    "third": (
        spaces.Dict({"a": spaces.Dict({"b": MASKED})}),
        lambda seen, mask: {"a": {"b": {"seen": seen, "action_mask": mask}}},
        spaces.Dict({"a/b": BOX}),
    ),
}


@pytest.mark.parametrize("space, build, expected", DEEP.values(), ids=DEEP)
def test_masks_on_any_level(space, build, expected):
    make = partial(Deep, space, build)
    env = make_team_env(make)
    obs: Any = env.reset()
    assert env.observation_space["walker_1"] == expected
    assert all(part.tolist() == [[0, 1, 0]] for part in obs["walker_1"].values())
    assert env.action_masks()["walker_1"].tolist() == [[False, True, True]]
    Team(MaskablePPO, "MultiInputPolicy", env, **KWARGS).learn(8)
    assert check_team_env(make, n_steps=20).failures == []


def test_the_mask_is_that_of_the_own_actions():
    other = spaces.Dict({"seen": BOX, "action_mask": spaces.MultiBinary(5)})
    env = make_team_env(partial(Deep, spaces.Dict({"own": MASKED, "other": other}), None))
    assert set(env.observation_space["walker_0"]) == {"own", "other/seen", "other/action_mask"}
    with pytest.raises(
        ValueError, match="'walker_0' has several action masks, 'a/action_mask' and 'b/action_mask': leave that"
    ):
        make_team_env(partial(Deep, spaces.Dict({"a": MASKED, "b": MASKED}), None))


@pytest.mark.parametrize(
    "space, build, name",
    [
        (spaces.Dict({"seen": BOX, "legal_mask": FLAGS}), lambda s, m: {"seen": s, "legal_mask": m}, "legal_mask"),
        (spaces.Dict({"seen": BOX, "avail_actions": FLAGS}), lambda s, m: {"seen": s, "avail_actions": m}, "avail_actions"),
        (spaces.Tuple([BOX, spaces.Box(0, 1, (3,), np.int8)]), lambda s, m: (s, m), "1"),
        (spaces.Tuple([BOX, spaces.MultiBinary(4)]), lambda s, m: (s, np.ones(4, np.int8)), None),
        (spaces.Dict({"seen": BOX, "bits": FLAGS}), lambda s, m: {"seen": s, "bits": m}, None),
    ],
)
def test_the_checker_notes_what_looks_like_a_mask(space, build, name):
    found = [str(f) for f in check_team_env(partial(Deep, space, build), n_steps=20).findings if "looks like a mask" in f.text]
    assert bool(found) == bool(name)
    if name:
        assert found[0].startswith("note  masks") and repr(name) in found[0]


@pytest.mark.parametrize(
    "key, name", [("", "_"), ("training", "training_"), ("forward", "forward_"), ("_modules", "_modules_")]
)
def test_keys_that_are_no_names_of_modules(key, name):
    env = make_team_env(partial(Deep, spaces.Dict({key: BOX, "other": BOX}), lambda seen, mask: {key: seen, "other": seen}))
    assert set(env.observation_space["walker_0"]) == {name, "other"}
    Team(PPO, "MultiInputPolicy", env, **PPO_KWARGS).learn(PPO_KWARGS["n_steps"])


def test_two_keys_that_get_one_name():
    with pytest.raises(ValueError, match="several entries that would be called '_'"):
        make_team_env(partial(Deep, spaces.Dict({"": BOX, "_": BOX}), None))


PIXELS = spaces.Box(0, 255, (3,), np.uint8)


@pytest.mark.parametrize(
    "space, value, shown",
    [
        (PIXELS, [0, 0.5, 1], "0.5"),
        (PIXELS, [0, 300, 1], "300"),
        (PIXELS, [-1.0, 0, 1], "-1.0"),
        (spaces.Box(-5, 5, (3,), np.int64), [0, 0.25, 1], "0.25"),
        (spaces.MultiDiscrete([3, 3, 3]), [0, 1.5, 1], "1.5"),
    ],
)
@pytest.mark.parametrize("step", [0, 4])
def test_numbers_that_the_cast_would_change(space, value, shown, step):
    class Cast(Walkers):
        obs_space = space

        def observe(self, agent):
            return np.array(value) if self.t == step else np.array([0.0, 2.0, 1.0])

    where = f"in environment copy 0 at {f'step {step}' if step else 'reset'}"
    with pytest.raises(ValueError, match=f"The observation of 'walker_0' {where} holds {shown}, but its observation space is"):
        play(make_team_env(Cast), 4)


class Colour(str, Enum):
    RED = "red"
    BLUE = "blue"


@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_names_that_are_text_and_something_else(vec_env):
    class Coloured(Walkers):
        def __init__(self):
            super().__init__()
            self.possible_agents = [Colour.RED, Colour.BLUE]

        def step(self, actions):
            assert all(type(agent) is Colour for agent in actions)
            return super().step(actions)

    env = make_team_env(Coloured, vec_env=vec_env)
    names = [str(colour) for colour in Colour]
    assert env.possible_agents == names
    for obs, rewards, *_ in play(env, 5):
        assert rewards.tolist() == [1.5] and obs[names[1]][0, 1] == 1
    env.close()


@pytest.mark.parametrize("make", [threading.Lock, lambda: (i for i in range(2)), lambda: {"deep": threading.Lock()}])
def test_infos_that_cannot_be_copied(make):
    held = make()

    class Holds(Walkers):
        def change(self, *parts):
            parts[4]["walker_0"]["held"] = held
            return (*parts[:4], {**parts[4], "game": held})

    *_, infos = play(make_team_env(Holds), 1)[0]
    assert infos[0]["agent_infos"]["walker_0"]["held"] is held and infos[0]["game"] is held
    Team(PPO, "MlpPolicy", make_team_env(Holds), **PPO_KWARGS).learn(PPO_KWARGS["n_steps"])
