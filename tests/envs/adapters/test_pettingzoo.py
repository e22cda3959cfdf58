"""``pettingzoo/<module>`` and ``to_parallel()``: conversions, masks, turns, agents that die, and the window of pursuit."""

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from mpe2 import simple_spread_v3
from pettingzoo.utils.conversions import parallel_to_aec

from sb3_belief.envs import check_team_env, make_parallel_env, to_parallel
from sb3_belief.envs.adapters.pettingzoo import ModelObservations, Pursuit, names
from sb3_belief.team import make_team_env
from tests.team.toy_envs import MixedEnv, ToyEnv


def newest(prefix):
    """Return the id of the newest version of a module whose name begins with a prefix."""
    return f"pettingzoo/{[name for name in names() if name.startswith(prefix)][-1]}"


PURSUIT, KNIGHTS, TICTACTOE, RPS = map(newest, ("sisl.pursuit", "butterfly.knights", "classic.tictactoe", "classic.rps"))


class MaskedObservations(ToyEnv):
    """A ``ToyEnv`` with masks within its observations, as is PettingZoo's convention. The last agent has none."""

    def observation_space(self, agent):
        space = super().observation_space(agent)
        if agent == self.possible_agents[-1]:
            return space
        return spaces.Dict({"observation": space, "action_mask": spaces.Box(0, 1, (3,), np.int8)})

    def observations(self):
        plain = super().observations()
        for i, agent in enumerate(self.agents[:-1]):
            # For one value of t + i in four no action is allowed
            mask = np.arange(3) == (self.t + i) if (self.t + i) % 4 < 3 else np.zeros(3)
            plain[agent] = {"observation": plain[agent], "action_mask": mask.astype(np.int8)}
        return plain

    def visibility(self):
        return {agent: np.array([self.t % 2 == 0] * (len(self.possible_agents) - 1)) for agent in self.possible_agents}


def test_masks_move_from_observations_to_infos():
    env: Any = to_parallel(MaskedObservations(3))
    assert isinstance(env, ModelObservations) and env.unwrapped is env
    assert env.observation_space("agent_0") == ToyEnv(3).observation_space("agent_0")
    assert env.limit == 7  # An attribute of the wrapped environment
    (obs, _), (plain, _) = env.reset(seed=1), ToyEnv(3).reset(seed=1)
    assert all((obs[agent] == plain[agent]).all() for agent in plain)
    masks = []
    for _ in range(3):
        *_, infos = env.step(dict.fromkeys(env.agents, 1))
        masks.append([infos[agent].get("action_mask", np.array([])).tolist() for agent in env.possible_agents])
    _, second, third = np.eye(3, dtype=bool).tolist()
    # Rows are steps 1 to 3. A mask that allows nothing stays so: a team finds out whether its agent could act
    assert masks == [[second, third, []], [third, [False] * 3, []], [[False] * 3, [False] * 3, []]]
    assert [row.tolist() for row in env.visibility().values()] == [[False, False]] * 3


def test_what_needs_no_conversion_is_left_as_it_is():
    env = MixedEnv()
    assert to_parallel(env) is env
    with pytest.raises(TypeError, match="needs an AECEnv or a ParallelEnv of PettingZoo, got dict"):
        to_parallel({})


def test_an_aec_environment_plays_as_its_parallel_one():
    converted, parallel = to_parallel(simple_spread_v3.env()), simple_spread_v3.parallel_env()
    rng = np.random.default_rng(0)
    a, b = converted.reset(seed=2), parallel.reset(seed=2)
    while parallel.agents:
        actions = {agent: int(rng.integers(5)) for agent in parallel.agents}
        a, b = converted.step(actions), parallel.step(actions)
        assert all((a[0][agent] == b[0][agent]).all() for agent in b[0])
        assert a[1:] == b[1:] and converted.agents == parallel.agents


def test_a_converted_environment_keeps_what_it_offers():
    env = make_team_env(lambda: to_parallel(parallel_to_aec(MixedEnv())))
    env.reset()
    actions: dict[str, Any] = {
        "zeta": np.zeros(1, int),
        "box": np.zeros((1, 2), np.float32),
        "multi": np.zeros((1, 2), int),
        "binary": np.zeros((1, 2), np.int8),
    }
    visible = env.step(actions)[3][0]["visible"]
    assert visible.tolist() == [[True, False, True], [True, True, False], [False, True, True], [True, False, True]]


def test_in_a_game_of_turns_only_the_one_on_turn_acts():
    env: Any = make_parallel_env(TICTACTOE)
    obs, infos = env.reset(seed=0)
    assert env.observation_space("player_1") == spaces.Box(0, 1, (3, 3, 2), np.int8)
    assert infos["player_1"]["action_mask"].all()
    # A model must choose some action, so the mask allows action 0, which is ignored
    assert infos["player_2"]["action_mask"].tolist() == [True] + [False] * 8
    assert not any(row.any() for row in env.visibility().values())
    for t, cell in enumerate([0, 3, 1, 4, 2]):
        mover = f"player_{t % 2 + 1}"
        obs, rewards, terminations, truncations, infos = env.step({"player_1": cell, "player_2": cell})
        # The player on turn is seen to act, the one that waits is not
        assert {agent: row.tolist() for agent, row in env.visibility().items()} == {
            "player_1": [mover == "player_2"],
            "player_2": [mover == "player_1"],
        }
    assert rewards == {"player_1": 1, "player_2": -1} and not env.agents
    assert all(terminations.values()) and not any(truncations.values())
    board = obs["player_1"].sum(axis=-1)
    assert board.sum() == 5


def test_a_team_plays_a_game_of_turns_by_its_masks():
    env: Any = make_team_env(TICTACTOE, n_envs=3, seed=0)
    env.reset()
    rng = np.random.default_rng(0)
    lengths = []
    for _ in range(200):
        masks = env.action_masks()
        # An illegal move would end the game with a penalty for that player only
        actions = {agent: np.array([rng.choice(np.flatnonzero(row)) for row in masks[agent]]) for agent in masks}
        _, _, dones, infos = env.step(actions)
        for i in np.flatnonzero(dones):
            lengths.append(infos[i]["episode"]["l"])
            assert infos[i]["life_end"].all() and sorted(infos[i]["agent_episode_rewards"]) in ([-1, 1], [0, 0])
    assert len(lengths) > 50 and 5 <= min(lengths) <= max(lengths) <= 9


def test_a_pursuer_sees_who_is_in_its_window():
    env: Any = make_parallel_env(PURSUIT, n_pursuers=6, x_size=10, y_size=10, max_cycles=40)
    assert isinstance(env, Pursuit)
    obs, _ = env.reset(seed=0)
    rng = np.random.default_rng(0)
    n_seen = 0
    while env.agents:
        obs, *_ = env.step({agent: int(rng.integers(5)) for agent in env.agents})
        visible = env.visibility()
        for agent in env.possible_agents:
            # The second channel counts the pursuers in each cell of the window, which includes the viewer in the middle
            window = obs[agent][..., 1]
            n_seen += visible[agent].sum()
            # Observations and visibility are both taken after all have moved
            assert visible[agent].sum() == window.sum() - 1
    assert 0 < n_seen


def test_agents_that_die_leave_the_team_and_the_rest_go_on():
    env: Any = make_team_env(KNIGHTS, seed=4, env_kwargs={"spawn_delay": 3, "max_zombies": 40})
    env.reset()
    rng = np.random.default_rng(0)
    gone = np.zeros(len(env.possible_agents), dtype=bool)
    early = 0
    for _ in range(900):
        actions = {agent: rng.integers(env.action_space[agent].n, size=1) for agent in env.possible_agents}
        obs, _, dones, infos = env.step(actions)
        assert not (infos[0]["active"] & gone).any() and not (infos[0]["life_end"] & gone).any()
        gone |= infos[0]["life_end"] | infos[0]["truncated"]
        if dones[0]:
            break
        early += gone.sum()
        assert [not obs[agent].any() for agent in env.possible_agents] == gone.tolist()
    assert dones[0] and gone.all() and early


@pytest.mark.parametrize("env_id", [PURSUIT, KNIGHTS, TICTACTOE, RPS])
def test_they_keep_the_contract(env_id):
    assert check_team_env(env_id, n_steps=40).failures == []


def test_unknown_names_and_missing_parts():
    with pytest.raises(ValueError, match=r"no 'sisl.persuit_v5'. Did you mean 'sisl.pursuit"):
        make_parallel_env("pettingzoo/sisl.persuit_v5")
    # A module of PettingZoo that is not an environment is not imported
    with pytest.raises(ValueError, match=r"no 'test.api_test'"):
        make_parallel_env("pettingzoo/test.api_test")


def test_what_an_environment_needs_besides_is_named(monkeypatch):
    def missing(name):
        raise ModuleNotFoundError("No module named 'pymunk'", name="pymunk")

    monkeypatch.setattr("sb3_belief.envs.adapters.pettingzoo.import_module", missing)
    with pytest.raises(ModuleNotFoundError, match=r"No module named 'pymunk'\): pip install 'pettingzoo\[butterfly\]'"):
        make_parallel_env(KNIGHTS)
