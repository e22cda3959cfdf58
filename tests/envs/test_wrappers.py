"""SuperSuit's wrappers around a team's environment keep what it offers besides observations: visibility, masks and ends."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
import supersuit
from pettingzoo import ParallelEnv

from sb3_belief import BeliefPPO, MaskableBeliefPPO, Team, make_team_env

WRAPPERS: dict[str, Callable[[ParallelEnv], ParallelEnv]] = {
    "frame_stack": partial(supersuit.frame_stack_v1, stack_size=3),
    "pad_observations": supersuit.pad_observations_v0,
    "pad_action_space": supersuit.pad_action_space_v0,
    "dtype": partial(supersuit.dtype_v0, dtype=np.float64),
    "flatten": supersuit.flatten_v0,
    "agent_indicator": supersuit.agent_indicator_v0,
    "normalize_obs": partial(supersuit.normalize_obs_v0, env_min=0, env_max=1),
    "several": lambda env: supersuit.agent_indicator_v0(supersuit.dtype_v0(supersuit.frame_stack_v1(env, 2), np.float32)),
}


def played(wrapper: Callable[[ParallelEnv], ParallelEnv] | None) -> list[dict[str, Any]]:
    """
    Play sixty steps (three episodes) of a junction, with the same actions whatever the wrapper.

    :param wrapper: The wrapper. None for none
    :return: For each step visibility, flags, masks, rewards and success
    """
    env = make_team_env("traffic-junction-easy", n_envs=1, seed=0, wrapper=wrapper or (lambda env: env))
    env.reset()
    rng = np.random.default_rng(0)
    seen: list[dict[str, Any]] = []
    for _ in range(60):
        masks = env.action_masks()
        assert masks is not None
        _, rewards, dones, infos = env.step({agent: rng.integers(2, size=1) for agent in env.possible_agents})
        keys = ("visible", "active", "life_end", "truncated", "agent_rewards")
        seen.append({key: infos[0][key] for key in keys})
        seen[-1].update(masks=np.stack(list(masks.values())), reward=rewards, done=dones, success=infos[0].get("is_success"))
    return seen


@pytest.mark.parametrize("name", WRAPPERS)
def test_visibility_masks_and_ends_survive(name):
    for step, (plain, wrapped) in enumerate(zip(played(None), played(WRAPPERS[name]), strict=True)):
        for key, value in plain.items():
            assert np.array_equal(value, wrapped[key]), f"{key} at step {step}"


@pytest.mark.parametrize("name", ["frame_stack", "agent_indicator", "several"])
def test_a_team_with_beliefs_learns_behind_wrappers(name):
    env = make_team_env("traffic-junction-easy", n_envs=2, seed=0, wrapper=WRAPPERS[name])
    for algorithm in (BeliefPPO, MaskableBeliefPPO):
        team = Team(algorithm, "BeliefPolicy", env, seed=0, n_steps=20, batch_size=20, history_length=40)
        team.learn(80)
        logged = next(iter(team.agents.values())).logger.name_to_value
        assert logged["belief/first_log_ratio"] < 1e-5 and 0 < logged["belief/visible_fraction"] < 1


def test_observations_are_those_of_the_wrapper():
    env = make_team_env("traffic-junction-easy", wrapper=WRAPPERS["frame_stack"])
    plain = make_team_env("traffic-junction-easy")
    assert env.observation_space["car_0"].shape == (3 * plain.observation_space["car_0"].shape[0],)


def test_black_death_is_refused_with_the_reason():
    with pytest.raises(ValueError, match=r"black_death_v3 is not needed.*Leave it out"):
        make_team_env(
            "traffic-junction-easy", wrapper=lambda env: supersuit.dtype_v0(supersuit.black_death_v3(env), np.float64)
        )
