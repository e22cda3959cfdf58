"""Games of PettingZoo's agent-environment cycle: who acts when, what trains, who is told what they earned."""

from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from pettingzoo import AECEnv
from sb3_contrib import MaskablePPO
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback

from sb3_belief import AgentEnv, BeliefPPO, MaskableBeliefPPO
from sb3_belief.belief.memory import DEPLOYED, valid_rows
from sb3_belief.belief_ppo import BeliefRolloutBuffer
from sb3_belief.envs import check_team_env, to_parallel
from sb3_belief.team import observing
from tests.team.helpers import Team, make_team_env

KWARGS: dict[str, Any] = {"n_steps": 24, "batch_size": 24, "n_epochs": 1, "device": "cpu"}


class Heap(AECEnv):
    """
    Players take one or two stones in turn; whoever takes the last one wins a point, and each move pays the next player 0.1.

    :param n: Number of players
    :param stones: Number of stones
    :param masks: ``"own"`` for masks that allow nothing off turn, ``"all"`` for the same masks at any time, None for none
    :param out: Whether whoever takes two stones of an even heap is out
    :param again: Whether whoever takes one stone of an even heap moves again
    :param parallelizable: What the metadata say
    """

    def __init__(self, n=3, stones=9, masks=None, out=False, again=False, parallelizable: Any = False):
        super().__init__()
        self.metadata = {"name": "heap_v0", "is_parallelizable": parallelizable, "render_modes": []}
        self.render_mode = None
        self.possible_agents = [f"player_{i}" for i in range(n)]
        self.stones, self.masks, self.out, self.again = stones, masks, out, again

    def observation_space(self, agent):
        heap = spaces.Box(0, 1, (1,), np.float32)
        return heap if self.masks is None else spaces.Dict({"heap": heap, "action_mask": spaces.MultiBinary(2)})

    def action_space(self, agent):
        return spaces.Discrete(2)

    def observe(self, agent):
        heap = np.array([max(self.heap, 0) / self.stones], np.float32)
        if self.masks is None:
            return heap
        able = self.masks == "all" or agent == self.agent_selection
        return {"heap": heap, "action_mask": np.array([able, able and self.heap > 1], np.int8)}

    def reset(self, seed=None, options=None):
        self.agents, self.heap = self.possible_agents[:], self.stones
        self.rewards = dict.fromkeys(self.agents, 0.0)
        self._cumulative_rewards = dict(self.rewards)
        self.terminations, self.truncations = dict.fromkeys(self.agents, False), dict.fromkeys(self.agents, False)
        self.infos: dict[str, dict] = {agent: {} for agent in self.agents}
        self.agent_selection = self.agents[0]

    def step(self, action):
        mover = self.agent_selection
        if self.terminations[mover]:
            self._was_dead_step(action)
            return
        self._cumulative_rewards[mover] = 0.0
        self._clear_rewards()
        even, alone = self.heap % 2 == 0, len(self.agents) == 1
        self.heap -= 1 + action
        following = self.agents[(self.agents.index(mover) + 1) % len(self.agents)]
        if self.heap <= 0 or alone:
            self.rewards[mover] = 1.0
            self.terminations = dict.fromkeys(self.agents, True)
        else:
            self.rewards[following] = 0.1
            self.terminations[mover] = self.out and even and action == 1
        self.agent_selection = mover if self.again and even and action == 0 else following
        self._accumulate_rewards()
        self._deads_step_first()


def game(**kwargs):
    """Return the converted game."""
    return to_parallel(Heap(**kwargs))


def played(env, actions):
    """Step a team environment of one copy, and return its infos."""
    env.reset()
    return [env.step({agent: np.array([action]) for agent in env.possible_agents})[3][0] for action in actions]


def test_only_the_one_on_turn_is_active_and_seen():
    infos = played(make_team_env(game), [0, 1, 0, 1, 0])
    assert [info["active"].tolist() for info in infos[:4]] == [
        [True, False, False],
        [False, True, False],
        [False, False, True],
        [True, False, False],
    ]
    # Rows of visible: the others of each player. All who wait see the one whose turn it is
    assert infos[1]["visible"].tolist() == [[True, False], [False, False], [False, True]]
    assert infos[1]["agent_rewards"].tolist() == np.array([0, 0, 0.1], np.float32).tolist()


def test_an_adaptive_belief_remembers_what_it_sees_while_it_waits():
    env = make_team_env(partial(game, n=3, stones=14), n_envs=2)
    kwargs: dict[str, Any] = {**KWARGS, "belief": "adaptive", "action_loss": "cross_entropy", "history_length": 12}
    team = Team(BeliefPPO, "BeliefPolicy", env, seed=0, n_pool=0, critic_sees_others=True, **kwargs)
    for _ in range(3):
        team.learn(24 * 2, reset_num_timesteps=False)
        for model in team.agents.values():
            assert model.logger.name_to_value["belief/first_log_ratio"] < 1e-5
    for model in team.agents.values():
        buffer = model.rollout_buffer
        # The first get() of the update has put the copies one after the other
        active, selected = buffer.active.reshape(2, 24), buffer.selected.reshape(2, 24, -1)
        n_frozen = 12
        rows = [row - n_frozen for copy, t in np.argwhere(active) for row in selected[copy, t] if row >= n_frozen]
        assert len(rows) > 12 and not active[[row % 2 for row in rows], [row // 2 for row in rows]].any()
        # At its own turn nobody else acts, so there is nothing that the baseline could see
        assert not buffer.belief_minibatch(np.flatnonzero(buffer.active)).seen_at_once.any()
        # Each row is a move of another player, seen while the agent did nothing
        history = model.policy.history
        assert history.valid.all() and (history.actions.sum(dim=1) == 1).all() and not history.own[:, :-1].any()
        # What the one before pays is paid while the agent waits
        assert set(history.own[:, -1].tolist()) <= {0.0, np.float32(0.1)} and history.own[:, -1].any()

    def taken(actions: dict[str, Any]) -> dict[str, np.ndarray]:
        return {agent: np.zeros(2, dtype=int) for agent in actions}

    before = {agent: model.policy.history for agent, model in team.agents.items()}
    with observing(team, make_team_env(partial(game, n=3, stones=14), n_envs=2)) as watched:
        watched.reset()
        for _ in range(5):
            watched.step(taken(team.agents))  # type: ignore[arg-type]
        # Moves 0 to 4: of the others after the first of its own
        for agent, seen in {"player_0": 3, "player_1": 2, "player_2": 2}.items():
            kept = valid_rows(team.agents[agent].policy.history)
            deployed = kept.stamps[:, 1] <= DEPLOYED
            assert deployed.sum() == 2 * seen and not kept.own[deployed, :-1].any()
    assert all(th.equal(model.policy.history.stamps, before[agent].stamps) for agent, model in team.agents.items())


@pytest.mark.parametrize("n_steps", [24, 23])
def test_a_belief_learns_from_what_others_do_between_two_turns(n_steps):
    env = make_team_env(partial(game, n=3, stones=14), n_envs=2)
    kwargs = {**KWARGS, "n_steps": n_steps, "batch_size": n_steps}
    team = Team(BeliefPPO, "BeliefPolicy", env, seed=0, **kwargs)
    played = []

    class Watches(BaseCallback):
        """Collects who moved in which way in each copy, and where episodes ended."""

        def _on_step(self):
            actions, infos = self.locals["actions"], self.locals["infos"]
            moves = [info["active"].argmax() for info in infos]
            taken = [int(actions[f"player_{moved}"][copy]) for copy, moved in enumerate(moves)]
            played.append((moves, taken, list(self.locals["dones"])))
            return True

    team.learn(2 * n_steps, callback=Watches())
    seen = 0
    for i, model in enumerate(team.agents.values()):
        buffer, others = model.rollout_buffer, [j for j in range(3) if j != i]
        for copy, t in np.ndindex(2, n_steps):
            # The first get() of the update has put the copies one after the other
            row = copy * n_steps + t
            if not buffer.active[row]:
                continue
            expected = np.zeros((2, 2), np.float32)
            for s in range(t + 1, n_steps):
                moves, taken, _ = played[s]
                if played[s - 1][2][copy] or moves[copy] == i:
                    break
                expected[others.index(moves[copy]), taken[copy]] = 1.0
            assert buffer.others_actions[row].tolist() == expected.ravel().tolist()
            assert buffer.others_visible[row].tolist() == expected.any(axis=1).tolist()
            seen += int(expected.sum())
        assert np.isfinite(model.logger.name_to_value["belief/action_loss"])
        assert model.policy.history.actions.sum() > 0
    assert seen > 20


def test_who_is_out_of_the_game_sees_nobody():
    env = make_team_env(partial(game, stones=20, out=True))
    infos = played(env, [1, 1, 0, 0, 0, 0])
    gone = [info for info in infos if not info["agent_infos"].get("player_0")]
    assert gone and not any(info["visible"][0].any() for info in gone)


def test_who_is_next_is_told_before():
    infos = played(make_team_env(game), [0, 1, 0, 1, 0])
    for before, after in pairwise(infos[:4]):
        told = [before["agent_infos"][f"player_{i}"]["next_active"] for i in range(3)]
        assert told == after["active"].tolist()
        # A mean over the agents would say nothing
        assert "next_active" not in before


@pytest.mark.parametrize("n_steps", [24, 25])
def test_nothing_is_bootstrapped_from_what_is_seen_off_turn(n_steps, monkeypatch):
    """The critic's opinion of the last observation counts only for the player whose turn it is then."""
    env = make_team_env(partial(game, n=2, stones=100))
    team = Team(BeliefPPO, "BeliefPolicy", env, seed=0, **{**KWARGS, "n_steps": n_steps, "batch_size": n_steps})
    compute = BeliefRolloutBuffer.compute_returns_and_advantage
    seen = []

    def with_an_opinion(buffer, last_values, dones):
        seen.append(buffer)
        compute(buffer, th.full_like(last_values, 1e6), dones)

    monkeypatch.setattr(BeliefRolloutBuffer, "compute_returns_and_advantage", with_an_opinion)
    monkeypatch.setattr(BeliefPPO, "train", lambda model: None)
    team.learn(n_steps)
    # Whose turn it is after the rollout
    on_turn = n_steps % 2
    for i, buffer in enumerate(seen):
        assert (np.abs(buffer.advantages[buffer.active]) > 1e3).any() == (i == on_turn)


def test_the_steps_that_train_are_those_on_turn():
    team = Team(BeliefPPO, "BeliefPolicy", make_team_env(partial(game, n=2, stones=100)), seed=0, **KWARGS).learn(24)
    for i, model in enumerate(team.agents.values()):
        assert model.rollout_buffer.active.ravel().tolist() == [t % 2 == i for t in range(24)]


def test_what_is_earned_off_turn_counts_for_the_move_before():
    env = make_team_env(partial(game, n=2, stones=6, masks="own"))
    kwargs = {**KWARGS, "gamma": 1.0, "gae_lambda": 1.0}
    team = Team(MaskableBeliefPPO, "BeliefPolicy", env, seed=0, **kwargs).learn(24)
    for model in team.agents.values():
        buffer = model.rollout_buffer
        rewards, ends = buffer.rewards[:, 0], np.flatnonzero(buffer.episode_starts[:, 0])
        earned_off_turn = 0.0
        for start, stop in pairwise(ends):
            active = buffer.active[start:stop].ravel()
            for t in np.flatnonzero(active):
                expected = rewards[start + t : stop].sum()
                assert buffer.returns[start + t, 0] == pytest.approx(expected, abs=1e-5)
                earned_off_turn += rewards[start:stop][t:][~active[t:]].sum()
        assert earned_off_turn > 0


@pytest.mark.parametrize("masks", [None, "own", "all"])
@pytest.mark.parametrize("kind", ["plain", "out", "again"])
def test_teams_learn_in_games_of_all_kinds(masks, kind):
    env = make_team_env(partial(game, masks=masks, stones=12, **({} if kind == "plain" else {kind: True})), n_envs=2)
    names = env.possible_agents
    masked = [MaskableBeliefPPO, MaskablePPO, MaskableBeliefPPO]
    algorithms = dict(zip(names, masked if masks else [BeliefPPO, PPO, DQN], strict=True))
    policies = {name: "BeliefPolicy" if "Belief" in algorithms[name].__name__ else "MlpPolicy" for name in names}
    own = {name: KWARGS for name in names if algorithms[name] is not DQN}
    team = Team(algorithms, policies, env, agent_kwargs=own, seed=0).learn(96)
    lengths = [episode["l"] for episode in team.ep_info_buffer]
    assert lengths and 3 <= min(lengths) <= max(lengths) <= 12
    assert check_team_env(partial(game, masks=masks, **({} if kind == "plain" else {kind: True})), n_steps=40).failures == []


def test_who_is_out_leaves_the_game_and_it_goes_on():
    env = make_team_env(partial(game, stones=10, out=True))
    first, second, *_ = played(env, [1, 0, 0, 1])
    assert first["life_end"].tolist() == [True, False, False] and second["active"].tolist() == [False, True, False]


def test_off_turn_a_model_chooses_nothing_whatever_the_game_allows():
    for masks in ("own", "all"):
        env = make_team_env(partial(game, masks=masks))
        env.reset()
        given: Any = env.action_masks()
        assert [row.tolist() for row in given.values()] == [[[True, True]], [[True, False]], [[True, False]]]


def test_one_learner_among_partners_waits_for_its_turn():
    partners = {"player_0": lambda obs: 0, "player_2": lambda obs: 0}
    env = AgentEnv(partial(game, stones=6), "player_1", partners)
    env.reset(seed=0)
    active = [env.step(1)[4]["active"] for _ in range(3)]
    assert active == [False, True, False]
    PPO("MlpPolicy", env, **KWARGS).learn(24)


@pytest.mark.parametrize(
    ("kwargs", "why"),
    [
        ({"masks": "own"}, "the action mask of 'player_1' allows nothing"),
        ({"again": True, "stones": 10}, "expected agent player_1 got agent player_0"),
        ({"out": True, "stones": 10}, "expected agent player_1 got agent player_0"),
    ],
)
def test_a_game_of_turns_that_claims_to_be_parallelizable_is_found_out(kwargs, why):
    env = make_team_env(partial(game, parallelizable=True, **kwargs))
    says = rf"Heap is not played by all agents at once.*{why}.* Use sb3_belief.envs.to_parallel\(env, turn_based=True\)"
    with pytest.raises(ValueError, match=says):
        for action in (0, 1):
            played(env, [action])
    failures = check_team_env(partial(game, parallelizable=True, **kwargs), n_steps=40).failures
    assert "turn_based=True" in failures[0].text


def test_turn_based_overrides_the_metadata():
    env = make_team_env(lambda: to_parallel(Heap(parallelizable=True), turn_based=True))
    assert played(env, [0])[0]["active"].tolist() == [True, False, False]
    env = make_team_env(lambda: to_parallel(Heap(), turn_based=False))
    assert played(env, [0])[0]["active"].tolist() == [True, True, True]


def test_turn_based_is_for_games_in_turns():
    parallel = to_parallel(Heap())
    with pytest.raises(ValueError, match=r"turn_based=True says how to convert an AECEnv, .* 'active'|leave it out"):
        to_parallel(parallel, turn_based=True)
