"""Foraging beside a scripted player: what it does, what the learner sees of it, and what it is worth to know it."""

import pickle
from typing import Any

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test

from sb3_belief.envs import SUITES, Suite, make_parallel_env
from sb3_belief.envs.foraging_partners import PartneredForaging
from sb3_belief.envs.foraging_partners.partners import PARTNERS, Situation, action_towards
from sb3_belief.envs.foraging_partners.policies import FollowingPicker, KnowingPicker, RememberingPicker
from sb3_belief.envs.reference_policies import reference_returns
from sb3_belief.team import make_team_env
from sb3_belief.team.lockstep.joint_loop import JointLoop

ME = "agent_0"
IDS = ["picker", "lbf-heuristics"]


def situation(foods, me, other, level=1, other_level=1):
    """Return the situation of a scripted player on a field of 8 x 8 with food {cell: level}."""
    field = np.zeros((8, 8), dtype=int)
    for cell, food in foods.items():
        field[cell] = food
    return Situation(field, sorted(foods), me, other, level, level + other_level)


def play(env, n_steps, seed=0):
    """Play at random, and return all that was seen and told."""
    generator = np.random.default_rng(seed)
    seen: list[Any] = []
    for _ in range(n_steps):
        if not env.agents:
            seen.append(env.reset()[0][ME].tolist())
        obs, rewards, ends, cuts, infos = env.step({ME: int(generator.integers(6))})
        seen.append((obs[ME].tolist(), rewards[ME], ends[ME], cuts[ME], infos["partner"], env.scripted_actions()))
    return seen


def test_heuristics_choose_as_they_are_described():
    heuristics = PARTNERS["heuristics"]
    now = situation({(1, 1): 3, (4, 4): 2, (6, 1): 1}, me=(1, 3), other=(6, 6))
    # The centre of both players is (4, 4); of level 1, alone or with another, only some of the food can be loaded
    assert [heuristics[name](now) for name in ("H1", "H2", "H3", "H4")] == [(1, 1), (4, 4), (6, 1), (4, 4)]
    strong = situation({(1, 1): 3, (4, 4): 4, (6, 1): 1}, me=(1, 3), other=(6, 6), level=3)
    assert [heuristics[name](strong) for name in ("H3", "H4")] == [(1, 1), (4, 4)]
    weak = situation({(1, 1): 3, (4, 4): 3}, me=(1, 3), other=(6, 6))
    assert heuristics["H3"](weak) is heuristics["H4"](weak) is None


def test_orders_are_kept():
    foods = {(1, 1): 2, (4, 4): 2, (6, 1): 2}
    now = situation(foods, me=(1, 3), other=(6, 6))
    assert {name: choose(now) for name, choose in PARTNERS["orders"].items()} == {
        "0-1-2": (1, 1), "0-2-1": (1, 1), "1-0-2": (4, 4), "1-2-0": (4, 4), "2-0-1": (6, 1), "2-1-0": (6, 1)
    }  # fmt: skip
    now.field[4, 4] = 0
    assert PARTNERS["orders"]["1-2-0"](now) == (6, 1) and now.left == [(1, 1), (6, 1)]


def test_a_player_goes_the_shortest_way_around_what_stands_there():
    field = np.zeros((8, 8), dtype=int)
    field[3, 3] = field[3, 5] = 1
    assert action_towards((3, 5), field, me=(3, 4), other=(0, 0)) == 5
    assert action_towards((3, 5), field, me=(0, 5), other=(7, 7)) == 2
    # Round the other player, and round food
    assert action_towards((3, 5), field, me=(0, 5), other=(1, 5)) in (3, 4)
    assert action_towards((3, 5), field, me=(3, 2), other=(7, 7)) in (1, 2)
    # In a corner behind the other player and food there is no way, so it waits for it to leave
    field[0, 1] = 1
    assert action_towards((3, 5), field, me=(0, 0), other=(1, 0)) == 2


@pytest.mark.parametrize("env_id", IDS)
def test_rewards_ends_and_observations_step_by_step(env_id):
    env = make_parallel_env(env_id)
    limit, coop = (20, True) if env_id == "picker" else (50, False)
    generator, collected, ends, seen_rows, hidden = np.random.default_rng(0), 0, 0, 0, 0
    for episode in range(25):
        obs, _ = env.reset(seed=episode)
        game, steps = env._game, 0
        cells = [tuple(cell) for cell in np.argwhere(game.field)]
        levels = {cell: int(game.field[cell]) for cell in cells}
        assert not coop or set(levels.values()) == {sum(player.level for player in game.players)}
        while env.agents:
            # Beside food the learner loads, so that some is collected
            beside = game.adjacent_food(*game.players[0].position) > 0
            obs, rewards, terminations, truncations, infos = env.step({ME: 5 if beside else int(generator.integers(1, 5))})
            steps += 1
            left = [cell for cell in cells if game.field[cell]]
            expected = [[*cell, levels[cell]] if cell in left else [-1, -1, 0] for cell in cells]
            me, other = ([*map(int, player.position), int(player.level)] for player in game.players)
            in_sight = max(abs(me[0] - other[0]), abs(me[1] - other[1])) <= 2 or not coop
            assert obs[ME].reshape(5, 3).tolist() == [*expected, me, other if in_sight else [-1, -1, 0]]
            assert env.observation_space(ME).contains(obs[ME])
            assert env.visibility()[ME].tolist() == [in_sight] and infos["partner"] == env.partner
            seen_rows, hidden = seen_rows + in_sight, hidden + (not in_sight)
            collected += rewards[ME]
            assert terminations[ME] == (not left) and truncations[ME] == (bool(left) and steps == limit)
            assert "partner" not in infos[ME]
        ends += terminations[ME]
        assert infos[ME]["is_success"] == terminations[ME]
    assert collected > 1 and seen_rows > 0 and (hidden > 0) == coop


@pytest.mark.parametrize("env_id", IDS)
def test_a_return_is_the_share_of_food(env_id):
    env = make_parallel_env(env_id)
    shares = []
    for episode in range(6):
        env.reset(seed=episode)
        total, share = env._game.field.sum(), 0.0
        while env.agents:
            now = env.situation()
            food = env._choices[env.partner](now) or now.left[0]
            # The learner helps
            share += env.step({ME: action_towards(food, now.field, now.other, now.me)})[1][ME]
        assert share == pytest.approx(1 - env._game.field.sum() / total)
        shares.append(share)
    assert np.mean(shares) > 0.3


def test_on_a_small_field_a_picker_takes_what_there_is():
    env = make_parallel_env("picker", game="Foraging-5x5-2p-3f-coop-v3")
    counts = set()
    for episode in range(30):
        env.reset(seed=episode)
        counts.add(len(env.situation().foods))
        while env.agents:
            env.step({ME: 0})
    assert len(counts) > 1


def test_a_type_stays_for_ten_episodes():
    def types(seed, **kwargs):
        env, met = make_parallel_env("picker", **kwargs), []
        for episode in range(120):
            env.reset(seed=seed if episode == 0 else None)
            met.append(env.partner)
        return np.array(met).reshape(12, 10)

    met = types(0)
    assert (met == met[:, :1]).all() and len(np.unique(met)) > 3
    assert (met == types(0)).all() and (met != types(1)).any() and (met != types(0, partner_seed=1)).any()
    assert {make_parallel_env("lbf-heuristics").partner} <= {"H1", "H2", "H3", "H4"}


def test_only_the_oracle_is_told_the_order():
    def seen(n_steps, **kwargs):
        env = make_team_env("picker", 3, seed=0, env_kwargs=kwargs)
        loop, told, met = JointLoop(env), [env.reset()[ME]], []
        with pytest.raises(AttributeError, match="not 'partner'"):
            loop.agent_envs[ME].get_attr("partner")
        for _ in range(n_steps):
            actions = {ME: np.array([1, 4, 2])}
            step = env.step(actions)
            ((obs, _, _, infos),) = loop._splitter.split(actions, step)
            assert not any("partner" in info for info in infos)
            for info in infos:
                assert info["others_visible"].any() == info["others_actions"].any()
            met.append([info["partner"] for info in step[3]])
            told.append(obs)
        assert met[-1] == env.get_attr("partner")
        env.close()
        return np.array(told), met

    (obs, met), (obs2, met2) = seen(1, partner_sight=0), seen(1, partner_sight=0, partner_seed=2)
    assert met != met2
    np.testing.assert_array_equal(obs, obs2)
    (obs, met), (told, met3) = seen(15), seen(15, reveal_partner=True)
    names = list(PARTNERS["orders"])
    np.testing.assert_array_equal(told[:, :, :15], obs)
    assert met3 == met and told[3, :, 15:].tolist() == [np.eye(6)[names.index(name)].tolist() for name in met[0]]


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize("at", [0, 7, 130])
def test_state_resumes_exactly(env_id, at):
    env, other = (make_parallel_env(env_id, redraw_every=2) for _ in range(2))
    env.reset(seed=1)
    play(env, at)
    state = pickle.loads(pickle.dumps(env.get_state()))
    expected = play(env, 200, seed=5)
    other.reset(seed=9)
    play(other, 3)
    other.set_state(state)
    assert play(other, 200, seed=5) == expected


@pytest.mark.filterwarnings("ignore:Agent was given info but was dead")
@pytest.mark.parametrize("env_id", IDS)
def test_pettingzoo_api(env_id):
    parallel_api_test(make_parallel_env(env_id, reveal_partner=True), num_cycles=60)


def test_what_it_is_worth_to_know_the_order():
    n_envs, episodes = 8, 20
    near = make_team_env("picker", n_envs)
    far = make_team_env("picker", n_envs, env_kwargs={"partner_sight": None})
    knows, blind, remembers = (
        reference_returns(policy, near, episodes).mean()
        for policy in (KnowingPicker(), RememberingPicker(n_envs, episodes=1), RememberingPicker(n_envs))
    )
    follows = reference_returns(FollowingPicker(n_envs), far, episodes).mean()
    # Those of docs/environments/teammates.md
    for found, expected in ((knows, 0.664), (remembers, 0.639), (blind, 0.571), (follows, 0.647)):
        assert found == pytest.approx(expected, abs=0.1)
    assert blind < remembers < knows
    near.close()
    far.close()


@pytest.mark.parametrize(
    "kwargs, says",
    [
        ({"partners": "H1"}, "partners='H1' is not one of 'orders', 'heuristics'"),
        ({"game": "Foraging-2s-8x8-2p-3f-v3"}, "must have two players in full sight and three foods"),
        ({"game": "Foraging-8x8-3p-3f-v3"}, "must have two players"),
        ({"partner_sight": -1}, "partner_sight=-1 must be an integer >= 0"),
        ({"max_episode_steps": None}, "max_episode_steps=None must be an integer >= 1"),
        ({"redraw_every": 0}, "redraw_every=0"),
        ({"redraw_unit": "rollouts"}, "rollout_steps=None"),
        ({"reveal_partner": 1}, "reveal_partner=1"),
    ],
)
def test_arguments_that_are_refused(kwargs, says):
    with pytest.raises(ValueError, match=says):
        PartneredForaging(**kwargs)


def test_wrong_actions_are_refused():
    env = PartneredForaging()
    with pytest.raises(ValueError, match="call reset"):
        env.step({ME: 0})
    env.reset()
    with pytest.raises(ValueError, match="No action for 'agent_0'"):
        env.step({})
    with pytest.raises(ValueError, match="'agent_0' is 6"):
        env.step({ME: 6})


def test_without_the_package_the_line_that_installs_it_is_told(monkeypatch):
    monkeypatch.setattr(Suite, "missing", lambda suite: list(suite.modules))
    for env_id in IDS:
        with pytest.raises(ModuleNotFoundError, match=f"'{env_id}' needs 'lbforaging'.*{SUITES['lbf'].install}"):
            make_parallel_env(env_id)


def test_a_picture():
    env = make_parallel_env("picker", render_mode="rgb_array")
    env.reset(seed=0)
    assert env.render().shape == (480, 480, 3) and env.picture_positions().keys() == {ME}
