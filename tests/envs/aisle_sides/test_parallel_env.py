"""The aisles as a PettingZoo environment: its interface, what agents are told, state, pictures and wrong use."""

import pickle
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from pettingzoo.test import parallel_api_test, parallel_seed_test

from sb3_belief.envs import AisleSides, check_team_env, make_batched_env, make_parallel_env
from sb3_belief.envs.aisle_sides.vec_env import AisleSidesVecEnv
from tests.envs.aisle_sides.variants import VARIANTS


@pytest.mark.parametrize("kwargs", VARIANTS)
@pytest.mark.filterwarnings("ignore:Agent was given info but was dead")
def test_pettingzoo_api_and_seeds(kwargs):
    # A warning of PettingZoo's tests would be a deviation from the interface, but for that of what is the team's info
    parallel_api_test(AisleSides(**kwargs), num_cycles=100)
    parallel_seed_test(lambda: AisleSides(**kwargs), num_cycles=100)


@pytest.mark.parametrize("env_id", ["aisle-sides", "aisle-sides-kinds"])
def test_the_env_checker_finds_nothing(env_id):
    report = check_team_env(env_id)
    assert not report.failures, str(report)


def test_what_agents_and_others_are_told():
    env = AisleSides(n_robots=2)
    assert env.possible_agents == ["robot_0", "robot_1"]
    assert list(env.scripted_action_spaces) == ["other_0", "other_1"]
    env.reset(seed=0)
    env.core.position[:], env.core.other[:] = [[2, 2]], [[4, 7]]
    _, _, _, _, infos = env.step({"robot_0": 1, "robot_1": 1})
    # The other learner, the robot in the own aisle, that in the other aisle
    assert env.visibility()["robot_0"].tolist() == [False, True, False]
    assert env.visibility()["robot_1"].tolist() == [False, False, False]
    side = {"left": 1, "right": 2}[env.partner]
    assert env.scripted_actions() == {"other_0": side, "other_1": 0}
    assert infos == {"robot_0": {}, "robot_1": {}, "partner": env.partner}


def test_only_the_oracle_observes_the_convention():
    def observed(partner_seed, **kwargs):
        env = AisleSides(redraw_every=None, partner_seed=partner_seed, **kwargs)
        seen = [env.reset(seed=5)[0]["robot_0"]]
        while env.agents:
            # Waiting in every meeting
            seen.append(env.step({"robot_0": 0})[0]["robot_0"])
        return env.partner, np.array(seen)

    found = {seed: observed(seed) for seed in range(8)}
    assert {name for name, _ in found.values()} == {"left", "right"}
    assert all(np.array_equal(seen, found[0][1]) for _, seen in found.values())
    for seed, (name, seen) in found.items():
        same, told = observed(seed, reveal_partner=True)
        assert same == name and np.array_equal(told[:, :-2], seen)
        in_sight = seen[:, 2:5].any(axis=1)
        assert in_sight.any() and (told[in_sight, -2:] == {"left": [1, 0], "right": [0, 1]}[name]).all()
        assert not told[~in_sight, -2:].any()


def play(env, n_steps):
    """Play and return all that was seen."""
    record = []
    for k in range(n_steps):
        if not env.agents:
            record.append(str(env.reset()))
        record.append(str(env.step({agent: (k + i) % 3 for i, agent in enumerate(env.agents)})))
        record.append(str((env.scripted_actions(), env.visibility(), env.partner)))
    return record


@pytest.mark.parametrize("kwargs", VARIANTS)
def test_state_resumes_exactly_in_another_environment(kwargs):
    for at in (0, 3, 11, 40):
        env = AisleSides(**kwargs)
        env.reset(seed=4)
        play(env, at)
        state = pickle.loads(pickle.dumps(env.get_state()))
        expected = play(env, 50)
        other = AisleSides(**kwargs)
        other.reset(seed=99)
        play(other, 2)
        other.set_state(state)
        assert play(other, 50) == expected
    with pytest.raises(ValueError, match="with the same arguments"):
        AisleSides(jam_steps=5).set_state(state)


def test_a_reset_with_a_seed_starts_the_sequence_of_conventions_anew():
    env = AisleSides(kinds=4, redraw_unit="episodes", per_copy=True, redraw_every=1, max_steps=5)
    env.reset(seed=1)
    first = play(env, 40)
    env.reset(seed=1)
    assert play(env, 40) == first
    env.reset(seed=2)
    assert play(env, 40) != first


@pytest.mark.parametrize(
    "kwargs, says",
    [
        ({"kinds": 0}, "kinds=0 must be an integer from 1 to 6"),
        ({"kinds": 7}, "kinds=7 must be an integer from 1 to 6"),
        ({"n_robots": 0}, "n_robots=0 must be an integer >= 1"),
        ({"sight": 1}, "sight=1 must be an integer >= 2"),
        ({"length": 4}, "length=4 must be an integer >= 5"),
        ({"traffic": 0}, "traffic=0 must be a probability"),
        ({"traffic": True}, "traffic=True must be a probability"),
        ({"jam_steps": 0}, "jam_steps=0 must be an integer >= 1"),
        ({"max_steps": 2.0}, "max_steps=2.0 must be an integer >= 1"),
        ({"others_visible": 1}, "others_visible=1 must be True or False"),
        ({"redraw_every": 0}, "every=0 must be an integer >= 1"),
        ({"held_out": True, "kinds": 2}, "held_out=True needs kinds >= 3"),
        ({"render_mode": "human"}, "render_mode='human' is not one of"),
    ],
)
def test_arguments_that_are_refused(kwargs, says):
    with pytest.raises(ValueError, match=says):
        AisleSides(**kwargs)
    with pytest.raises(ValueError, match=says):
        AisleSidesVecEnv(2, **kwargs)


def test_wrong_use():
    env = AisleSides(max_steps=1)
    with pytest.raises(ValueError, match="call reset"):
        env.step({"robot_0": 0})
    env.reset()
    with pytest.raises(ValueError, match="No action for 'robot_0'"):
        env.step({"other_0": 0})
    wrong: list[Any] = [3, -1, 0.5]
    for action in wrong:
        with pytest.raises(ValueError, match=r"allowed are 0 \(middle\), 1 \(left\) and 2 \(right\)"):
            env.step({"robot_0": action})
    env.step({"robot_0": 2})
    with pytest.raises(ValueError, match="made without a render mode"):
        env.render()
    with pytest.raises(ValueError, match="num_envs=0"):
        AisleSidesVecEnv(0)
    batched = AisleSidesVecEnv(2)
    batched.reset()
    for actions in (np.array([0, 3]), np.array([-1, 0]), np.array([0.0, 1.0])):
        with pytest.raises(ValueError, match="must be 0"):
            batched.step({"robot_0": actions})


def test_ids():
    for env_id, kinds in (("aisle-sides", 1), ("aisle-sides-kinds", 4)):
        single, batched = make_parallel_env(env_id, n_robots=2), make_batched_env(env_id, 3, n_robots=2)
        assert isinstance(single, AisleSides) and isinstance(batched, AisleSidesVecEnv)
        assert single.config == batched.config and single.config.kinds == kinds
        assert batched.scripted_action_spaces == single.scripted_action_spaces
        assert single.observation_space("robot_1") == spaces.Box(0.0, 1.0, (5 + kinds,), np.float32)


def test_pictures_show_where_robots_stand_and_step_aside():
    pytest.importorskip("pygame")
    env = AisleSides(kinds=2, n_robots=2, render_mode="rgb_array", redraw_every=None)
    env.reset(seed=0)
    env.core.position[:], env.core.other[:], env.core.kind[:] = 2, 4, 0
    side = int(env.core.sides[env.core.types.current[0], 0])
    before = env.render()
    env.step({"robot_0": side, "robot_1": 3 - side})
    after, positions = env.render(), env.picture_positions()
    assert before.shape == after.shape and (before != after).any()
    # Both step to the side of that name, in aisles that are 4 columns apart
    columns = {agent: round(x * 9 - 0.5) for agent, (x, _) in positions.items()}
    assert columns == {"robot_0": 2 + 2 * side - 3, "robot_1": 6 - (2 * side - 3)}
    rows = {agent: round(y * 9 - 0.5) for agent, (_, y) in positions.items()}
    assert rows == {"robot_0": 8 - 3, "robot_1": 8 - 2}
    batched = AisleSidesVecEnv(2, n_robots=2, render_mode="rgb_array")
    batched.reset()
    assert [image.shape for image in batched.get_images() if image is not None] == [after.shape] * 2
    assert batched.picture_positions() == {"robot_0": (2.5 / 9, 8.5 / 9), "robot_1": (6.5 / 9, 8.5 / 9)}
