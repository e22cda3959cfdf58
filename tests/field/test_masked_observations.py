"""Masks that come beside the observation, under whatever names, on every way into a team."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from sb3_contrib import MaskablePPO

from sb3_belief import AgentEnv, MaskableBeliefPPO
from sb3_belief.envs import check_team_env, to_parallel
from tests.team.helpers import Team, make_team_env
from tests.team.toy_envs import ToyEnv

KWARGS: dict[str, Any] = {"n_steps": 8, "batch_size": 8, "n_epochs": 1, "device": "cpu"}


class Guarded(ToyEnv):
    """
    A ``ToyEnv`` that gives each agent its observation beside a mask, and raises where an agent does what the mask forbids.

    :param key: Name of the observation
    :param third: Whether there is a third entry, a clock
    :param space: Action space of all agents
    """

    def __init__(self, key="observation", third=False, space=None):
        super().__init__(n_agents=3, limit=5)
        self.key, self.third, self.space = key, third, space or spaces.Discrete(3)

    def action_space(self, agent):
        return self.space

    def observation_space(self, agent):
        width = 5 if isinstance(self.space, spaces.MultiDiscrete) else 3
        mask: Any = spaces.Box(0, 1, (width,), np.int8)
        if isinstance(self.space, spaces.MultiDiscrete):
            mask = spaces.Tuple([spaces.MultiBinary(2), spaces.MultiBinary(3)])
        entries: dict[str, spaces.Space] = {self.key: super().observation_space(agent), "action_mask": mask}
        return spaces.Dict(entries | ({"clock": spaces.Discrete(6)} if self.third else {}))

    def mask(self, agent):
        allowed = (self.t + self.possible_agents.index(agent)) % 3
        if isinstance(self.space, spaces.MultiDiscrete):
            return np.array([0, 1], np.int8), (np.arange(3) == allowed).astype(np.int8)
        return (np.arange(3) == allowed).astype(np.int8)

    def observations(self):
        clock = {"clock": self.t} if self.third else {}
        return {
            agent: {self.key: seen, "action_mask": self.mask(agent), **clock} for agent, seen in super().observations().items()
        }

    def step(self, actions):
        for agent, action in actions.items():
            parts = self.mask(agent)
            for mask, chosen in zip(parts if isinstance(parts, tuple) else (parts,), np.atleast_1d(action), strict=True):
                if not isinstance(self.space, spaces.Box):
                    assert mask[chosen], f"{agent} did {action} at step {self.t}"
        return super().step(dict.fromkeys(actions, 1))


@pytest.mark.parametrize("key", ["observation", "obs", "observations", "what_i_see"])
def test_the_entry_beside_the_mask_is_the_observation(key):
    env = make_team_env(partial(Guarded, key), n_envs=2, seed=0)
    assert env.observation_space["agent_0"] == ToyEnv().observation_space("agent_0")
    obs: Any = env.reset()
    plain: Any = make_team_env(partial(ToyEnv, 3, 5), n_envs=2, seed=0).reset()
    for i, (agent, masks) in enumerate(env.action_masks().items()):
        np.testing.assert_array_equal(obs[agent], plain[agent])
        assert masks.tolist() == [np.eye(3, dtype=bool)[i].tolist()] * 2


def test_of_several_entries_beside_the_mask_a_dict_remains():
    env = make_team_env(partial(Guarded, "obs", third=True), seed=0)
    assert list(env.observation_space["agent_1"]) == ["clock", "obs"]
    obs: Any = env.reset()
    assert obs["agent_1"]["obs"].shape == (1, 2) and obs["agent_1"]["clock"].tolist() == [0]


@pytest.mark.parametrize("third", [False, True])
@pytest.mark.parametrize("space", [None, spaces.MultiDiscrete([2, 3])], ids=["discrete", "multi"])
@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_a_team_learns_by_these_masks(third, space, vec_env):
    env = make_team_env(partial(Guarded, "obs", third, space), n_envs=2, vec_env=vec_env)
    algorithms = {"agent_0": MaskableBeliefPPO, "agent_1": MaskablePPO, "agent_2": MaskableBeliefPPO}
    stock = "MultiInputPolicy" if third else "MlpPolicy"
    policies = {"agent_0": "BeliefPolicy", "agent_1": stock, "agent_2": stock}
    Team(algorithms, policies, env, seed=0, **KWARGS).learn(32)
    env.close()


def test_a_learner_with_partners_has_these_masks():
    def partner(obs, action_masks):
        assert obs.shape == (2,)
        return np.argmax(action_masks)

    env = AgentEnv(Guarded, "agent_1", {"agent_0": partner, "agent_2": partner})
    MaskablePPO("MlpPolicy", env, **KWARGS).learn(16)


def test_an_environment_that_is_made_has_them_split_by_to_parallel():
    env = to_parallel(Guarded("view"))
    obs, infos = env.reset(seed=0)
    assert env.observation_space("agent_0").contains(obs["agent_0"])
    assert infos["agent_2"]["action_mask"].tolist() == [False, False, True]


def test_the_checker_plays_by_these_masks():
    report = check_team_env(partial(Guarded, "obs", third=True), n_steps=30)
    assert report.failures == [] and "of 3 agents, 33% of the actions are possible" in str(report)


def test_an_entry_of_that_name_for_actions_without_masks_stays_part_of_the_observation():
    env = make_team_env(partial(Guarded, space=spaces.Box(-1, 1, (1,))))
    assert list(env.observation_space["agent_0"]) == ["action_mask", "observation"] and env.action_masks() is None


def test_an_observation_without_its_mask_is_named():
    class Forgets(Guarded):
        def observations(self):
            return {agent: {"observation": obs["observation"]} for agent, obs in super().observations().items()}

    with pytest.raises(ValueError, match="observation of 'agent_0' has no entry 'action_mask'"):
        make_team_env(Forgets).reset()


class Turns(ToyEnv):
    """
    Agents that act in turn, the others with masks that allow nothing.

    :param tells: Whether the infos say who could not act
    """

    def __init__(self, tells=True):
        super().__init__(limit=6)
        self.tells = tells

    def on_turn(self, t):
        return self.possible_agents[t % 2]

    def infos(self):
        infos: dict[str, dict[str, Any]] = {
            agent: {"action_mask": np.ones(3) if agent == self.on_turn(self.t) else np.zeros(3)} for agent in self.agents
        }
        for agent in self.agents if self.tells and self.t else ():
            infos[agent]["active"] = agent == self.on_turn(self.t - 1)
        return infos


@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_who_cannot_act_may_have_a_mask_without_actions(vec_env):
    env = make_team_env(Turns, n_envs=2, vec_env=vec_env)
    env.reset()
    masks: Any = env.action_masks()
    # A model must choose something: the first action, which goes nowhere
    assert masks["agent_0"].all() and masks["agent_1"].tolist() == [[True, False, False]] * 2
    team = Team(MaskableBeliefPPO, "BeliefPolicy", env, seed=0, **KWARGS).learn(64)
    env.close()
    assert [int(model.rollout_buffer.active.sum()) for model in team.agents.values()] == [8, 8]
    assert check_team_env(Turns, n_steps=20).failures == []


def test_who_can_act_must_have_an_action():
    env = make_team_env(partial(Turns, tells=False), n_envs=2)
    env.reset()
    zeros = {agent: np.zeros(2, int) for agent in env.possible_agents}
    with pytest.raises(ValueError, match=r"'agent_1' in environment copy 0 at reset allows no action: .*\['active'\] = "):
        env.step(zeros)
    (failure,) = check_team_env(partial(Turns, tells=False), n_steps=20).failures
    assert "that of 'agent_1' at reset allows no action" in failure.text


def test_each_dimension_must_have_an_action():
    class Half(ToyEnv):
        def action_space(self, agent):
            return spaces.MultiDiscrete([2, 3])

        def infos(self):
            return {agent: {"action_mask": [1, 1, 0, 0, 0]} for agent in self.agents}

        def step(self, actions):
            return super().step(dict.fromkeys(actions, 1))

    env = make_team_env(Half)
    env.reset()
    masks: Any = env.action_masks()
    assert masks["agent_0"].tolist() == [[True, True, True, False, False]]
    with pytest.raises(ValueError, match="allows no action"):
        env.step({agent: np.zeros((1, 2), int) for agent in env.possible_agents})
    assert "that of 'agent_0' at reset allows no action" in check_team_env(Half, n_steps=20).failures[0].text
