"""SMAX's battles: visibility, masks, ends and deaths. They need jaxmarl in an environment of its own (``make test-smax``)."""

from importlib.util import find_spec

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test

from tests.envs.adapters.smax.helpers import (
    PEACE,
    STOP,
    UNIT_FEATURES,
    attack,
    make,
    make_batched,
    masked_choice,
    set_step,
)

pytestmark = pytest.mark.skipif(find_spec("jaxmarl") is None, reason="jaxmarl is not installed: run make test-smax")


# Sight and shooting ranges of SMAX's unit types in the order m M s Z z h, taken from its paper and source. They are repeated
# here, rather than read from the package, so that the tests do not depend on what they check
SIGHT = np.array([9, 10, 10, 9, 8, 9])
RANGE = np.array([5, 6, 6, 2, 2, 5])


def in_sight(units, n_agents):
    """Compute from the positions which agent sees which other, bool ``[n_agents, n_agents - 1]``."""
    positions, types, alive = (units[name][:n_agents] for name in ("positions", "types", "alive"))
    rows = []
    for i in range(n_agents):
        others = [j for j in range(n_agents) if j != i]
        distances = [np.hypot(*(positions[i] - positions[j]).astype(float)) for j in others]
        rows.append([bool(alive[i] and alive[j] and d < SIGHT[types[i]]) for j, d in zip(others, distances, strict=True)])
    return np.array(rows)


@pytest.mark.parametrize("map_name", ["2s3z", "3s5z"])
def test_visibility_equals_an_independent_computation(map_name):
    env = make_batched(map_name, 4)
    n_agents = len(env.possible_agents)
    env.seed(1)
    env.reset()
    generator = np.random.default_rng(1)
    # The units of all battles at the end of a step, before any battle is reset
    units: list[dict[str, np.ndarray]] = []
    step = env.battles.step

    def step_and_look(actions):
        result = step(actions)
        units[:] = [env.battles.units(copy) for copy in range(4)]
        return result

    env.battles.step = step_and_look
    # The battles start near the step limit, so that some units are still alive at an end
    states = env.get_state()
    for state in states:
        set_step(state, 85)
    env.set_state(states)
    before = np.ones((4, n_agents), dtype=bool)
    asymmetric = hidden = ends = np.int64(0)
    for _ in range(300):
        # Half of the time each unit walks in a direction of its own, so that the team scatters
        actions = masked_choice(env.action_masks(), generator)
        drift = {agent: np.full(4, i % 4) for i, agent in enumerate(env.possible_agents)}
        chosen = {agent: np.where(generator.random(4) < 0.5, actions[agent], drift[agent]) for agent in actions}
        dones, infos = env.step(chosen)[2:]
        for copy, info in enumerate(infos):
            expected = in_sight(units[copy], n_agents)
            np.testing.assert_array_equal(info["visible"], expected)
            np.testing.assert_array_equal(info["active"], before[copy])
            seen = np.zeros((n_agents, n_agents), dtype=bool)
            seen[~np.eye(n_agents, dtype=bool)] = expected.ravel()
            asymmetric += (seen != seen.T).sum()
            alive = units[copy]["alive"][:n_agents]
            hidden += (alive[:, None] & alive & ~seen).sum() - alive.sum()
            ends += dones[copy] and alive.any()
            before[copy] = True if dones[copy] else alive
            # The observation agrees: the blocks of units out of sight are empty
            last = info["terminal_observation"] if dones[copy] else None
            for i, agent in enumerate(env.possible_agents):
                obs = last[agent] if last else env.battles.observations[i, copy]
                blocks = obs[: (n_agents - 1) * UNIT_FEATURES].reshape(n_agents - 1, UNIT_FEATURES)
                np.testing.assert_array_equal(blocks[:, 0] > 0, expected[i])
    assert asymmetric > 0 and hidden > 0 and ends > 0


def test_the_last_actions_of_allies_are_blanked_unless_asked_for(mixed):
    shown = make_batched("2s3z", 4, observe_last_actions=True)
    n_allies = len(mixed.possible_agents)
    n_actions = mixed.action_space["ally_0"].n
    width = (n_allies - 1) * UNIT_FEATURES
    directions = np.array([[0, 1], [1, 0], [0, -1], [-1, 0]])
    for env in (mixed, shown):
        env.seed(4)
        env.reset()
    generator = np.random.default_rng(4)
    moved = shot = 0
    for _ in range(80):
        actions = masked_choice(mixed.action_masks(), generator)
        obs, _, dones, infos = mixed.step(actions)
        other = shown.step(actions)[0]
        for i, agent in enumerate(mixed.possible_agents):
            blocks = obs[agent][:, :width].reshape(4, n_allies - 1, UNIT_FEATURES)
            full = other[agent][:, :width].reshape(4, n_allies - 1, UNIT_FEATURES)
            assert not blocks[:, :, 3:6].any()
            np.testing.assert_array_equal(np.delete(blocks, [3, 4, 5], axis=2), np.delete(full, [3, 4, 5], axis=2))
            # The last actions of the enemies remain
            np.testing.assert_array_equal(obs[agent][:, width:], other[agent][:, width:])
            for copy in np.flatnonzero(~dones):
                for j, ally in enumerate(a for a in mixed.possible_agents if a != agent):
                    action = int(actions[ally][copy])
                    block = full[copy, j, 3:6]
                    if not infos[copy]["visible"][i, j]:
                        assert not block.any()
                        continue
                    expected = directions[action] if action < STOP else np.zeros(2)
                    np.testing.assert_allclose(block[:2], expected, atol=1e-6)
                    np.testing.assert_allclose(block[2], action / (n_actions - 1) if action > STOP else 0.0, rtol=1e-6)
                    moved += action < STOP
                    shot += action > STOP
    assert moved > 0 and shot > 0


@pytest.mark.parametrize("heeds_masks", [True, False])
def test_no_illegal_action_is_ever_sent(mixed, heeds_masks):
    battles, program = mixed.battles, mixed.battles._program
    n_allies, generator = len(mixed.possible_agents), np.random.default_rng(5)
    sent: list[np.ndarray] = []

    class Spy:
        def __getattr__(self, name):
            return getattr(program, name)

        def advance(self, keys, states, actions):
            assert actions.dtype == np.int32
            sent.append(actions)
            return program.advance(keys, states, actions)

    mixed.seed(5)
    mixed.reset()
    battles._program = Spy()
    try:
        stopped = shots = 0
        for _ in range(2500):  # Steps of 4 copies each
            before = [battles.units(copy) for copy in range(4)]
            masks = mixed.action_masks()
            everything = {agent: np.ones_like(mask) for agent, mask in masks.items()}
            actions = masked_choice(masks if heeds_masks else everything, generator)
            mixed.step(actions)
            chosen = np.stack(list(actions.values()), axis=1)
            for units, joint, wanted in zip(before, sent[-1], chosen, strict=True):
                alive, positions = units["alive"], units["positions"].astype(float)
                assert (joint[~alive[:n_allies]] == STOP).all()
                for i in np.flatnonzero(joint > STOP):
                    target = n_allies + joint[i] - 5
                    near = np.hypot(*(positions[i] - positions[target])) < RANGE[units["types"][i]]
                    assert alive[i] and alive[target] and near
                    shots += 1
                changed = joint != wanted
                assert (joint[changed] == STOP).all()
                stopped += changed.sum()
    finally:
        battles._program = program
    assert shots > 1000
    assert (stopped == 0) == heeds_masks


def test_nothing_is_compiled_after_the_first_step_and_reset(caplog):
    import jax

    env = make_batched("2s3z", 4)
    stay = {agent: np.full(4, STOP) for agent in env.possible_agents}
    env.seed(0)
    env.reset()
    env.step(stay)
    env.battles.reset(np.array([0]))
    with jax.log_compiles(), caplog.at_level("DEBUG"):
        env.step(stay)
        env.battles.reset(np.array([1, 2]))
        env.step(stay)
        env.set_state(env.get_state())
        env.step(stay)
        env.reset()
        env.step(stay)
        assert not [record for record in caplog.records if "Compiling" in record.getMessage()]
        jax.jit(lambda x: x + 1)(np.zeros(17))
    assert [record for record in caplog.records if "Compiling" in record.getMessage()], "compilations are logged"


def test_the_battle_ends_for_all_at_once():
    env = make("3m", **PEACE)
    parallel_api_test(env, num_cycles=30)
    env.reset(seed=0)
    steps, states = 0, []
    rewards: list[float] = []
    while env.agents:
        states.append(env.get_state())
        _, reward, terminations, truncations, infos = env.step(attack(env))
        assert len(set(reward.values())) == 1 and env.team_reward(reward) == reward["ally_2"]
        rewards.append(reward["ally_0"])
        steps += 1
    assert all(terminations.values()) and not any(truncations.values())
    assert all(info["is_success"] is True for info in infos.values())
    assert sum(rewards) == pytest.approx(2.0), "1 for all the health that the enemies had, 1 for the win"
    assert not any(infos[agent].get("life_end") for agent in infos)
    with pytest.raises(ValueError, match="reset"):
        env.step(dict.fromkeys(env.possible_agents, STOP))

    # At the step limit the same last step is still a win, while an idle one truncates without success
    state = states[-1]
    set_step(state["battle"], 100)
    for actions, won in ((None, True), (dict.fromkeys(env.possible_agents, STOP), False)):
        env.set_state(state)
        _, _, terminations, truncations, infos = env.step(attack(env) if actions is None else actions)
        assert set(terminations.values()) == {won} and set(truncations.values()) == {not won}
        assert {info["is_success"] for info in infos.values()} == {won} and not env.agents
    # SMAX compares the clock before it advances, so that an episode has one step more than max_steps
    set_step(state["battle"], 99)
    env.set_state(state)
    env.step(dict.fromkeys(env.possible_agents, STOP))
    assert env.agents


def test_who_dies_stays_inactive_and_is_given_the_teams_reward(mixed):
    mixed.seed(11)
    mixed.reset()
    generator = np.random.default_rng(11)
    dead_steps = rewarded = 0
    dead = np.zeros((4, 5), dtype=bool)
    for _ in range(200):
        masks = mixed.action_masks()
        for copy, i in np.argwhere(dead):
            agent = mixed.possible_agents[i]
            assert masks[agent][copy].tolist() == [k == STOP for k in range(10)]
            assert not mixed.battles.observations[i, copy].any()
        _, rewards, dones, infos = mixed.step(masked_choice(masks, generator))
        for copy, info in enumerate(infos):
            np.testing.assert_array_equal(info["active"], ~dead[copy])
            np.testing.assert_array_equal(info["agent_rewards"], np.full(5, rewards[copy]))
            assert (info["life_end"] | info["truncated"]).tolist() == [dones[copy]] * 5
            assert not info["visible"][dead[copy]].any()
            dead_steps += dead[copy].sum()
            rewarded += (info["agent_rewards"][dead[copy]] > 0).sum()
            died = info.get("agent_infos", {})
            assert dones[copy] or sorted(died) == [
                mixed.possible_agents[i] for i in np.flatnonzero(~mixed.battles._alive[copy])
            ]
            assert all(told == {"next_active": False} for told in died.values())
        dead = ~mixed.battles._alive
    assert dead_steps > 0 and rewarded > 0


def test_a_draw_is_no_success(mixed):
    mixed.seed(0)
    mixed.reset()
    states = mixed.get_state()
    for leaf in states[2]["leaves"]:
        if leaf.dtype == np.float32 and leaf.shape == (10,) and (leaf > 1).all():
            leaf[:] = 0.0  # The health of all units
    mixed.set_state(states)
    _, _, dones, infos = mixed.step({agent: np.full(4, STOP) for agent in mixed.possible_agents})
    assert dones.tolist() == [False, False, True, False]
    assert infos[2]["is_success"] is False and infos[2]["TimeLimit.truncated"] is False
    assert infos[2]["life_end"].all() and not infos[2]["truncated"].any()
