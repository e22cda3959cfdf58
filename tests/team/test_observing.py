"""Agents that observe while they are evaluated adapt to whom they meet, and afterwards are what they were."""

import itertools
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize

from sb3_belief import BeliefPPO
from sb3_belief import team as sb3_team
from sb3_belief.team import AgentEnv
from sb3_belief.zoo.evaluate import evaluate
from tests.team.helpers import PPO_KWARGS, Team, make_team_env
from tests.team.toy_envs import BlinkingEnv, MaskedEnv, ScriptedEnv, ToyEnv

# Typed as Any, since a team's environment is stepped by a dict
observing: Any = sb3_team.observing
BELIEF = {**PPO_KWARGS, "history_length": 60}
# The YAML entry of the conventions, which is trained for 60 of its 100 rollouts
CONVENTION: dict[str, Any] = dict(
    n_steps=16,
    batch_size=400,
    n_epochs=4,
    learning_rate=1e-3,
    gamma=0.0,
    gae_lambda=0.0,
    ent_coef=0.01,
    policy_kwargs={"net_arch": [32, 32], "embedding_dim": 32, "latent_dim": 16},
)
ROLLOUTS = 60
FRESH = 1_000_000


def convention(seed, **kwargs):
    """Make an environment with a convention that stays."""
    return make_team_env("convention-swap", n_envs=50, seed=seed, env_kwargs={"K": None, "seed": seed, **kwargs})


@pytest.fixture(scope="module")
def follower():
    """A team that has learned to follow whatever convention its history shows."""
    env = make_team_env("convention-swap", n_envs=50, seed=0)
    return Team(BeliefPPO, "BeliefPolicy", env, seed=0, device="cpu", **CONVENTION).learn(ROLLOUTS * 800)


def success(team, env):
    """Return the share of steps of one episode in each copy in which the follower did what the leader did."""
    mean: Any = evaluate_policy(team, env, n_eval_episodes=50)[0]
    return mean / 16


def state(team):
    """Return all of the agents' weights and histories as bytes."""
    return {
        (agent, name): value.numpy().tobytes()
        for agent, model in team.agents.items()
        for name, value in model.policy.state_dict().items()
    }


def test_observing_raises_success_beside_fresh_conventions(follower):
    before = state(follower)
    blind, adapted, again = [], [], []
    met: dict[tuple[int, ...], Any] = {}
    for seed in itertools.count(FRESH):
        if len(met) == 24:
            break
        env = convention(seed)
        met.setdefault(tuple(env.get_attr("convention")[0]), env)
    for env in met.values():
        blind.append(success(follower, env))
        with observing(follower, env, most_steps=800) as watched:
            evaluate_policy(follower, watched, n_eval_episodes=50, deterministic=False)
            assert watched.steps == {"follower": 800}
            adapted.append(success(follower, watched))
            assert watched.steps == {"follower": 800}
        again.append(success(follower, env))
    # Over all conventions, who does not observe is right in one of four
    assert np.mean(blind) == pytest.approx(0.25, abs=0.03) and np.mean(again) == pytest.approx(0.25, abs=0.03)
    assert np.mean(adapted) > 0.95
    assert state(follower) == before


def test_who_cannot_be_seen_is_not_observed(follower):
    env = convention(FRESH, leader_visible=False)
    with observing(follower, env) as watched:
        evaluate_policy(follower, watched, n_eval_episodes=50)
        history = follower.agents["follower"].policy.history
        assert watched.steps == {"follower": 800} and history.valid.all() and not history.actions.any()


@pytest.mark.parametrize("make", [BlinkingEnv, ScriptedEnv, "traffic-junction-easy"])
def test_histories_hold_what_a_training_would_remember(make):
    """The rollout buffer of a team that plays the same actions has the same active steps, in the same order."""
    kwargs = {**BELIEF, "n_steps": 40, "history_length": 120, "learning_rate": 0.0}
    env = make_team_env(make, n_envs=3, seed=4)
    team = Team(BeliefPPO, "BeliefPolicy", env, seed=0, **kwargs)
    played = []
    step_async = env.step_async

    def record(actions):
        played.append(actions)
        step_async(actions)

    env.step_async = record
    seed = int(np.random.default_rng(0).integers(2**20))
    env.seed(seed)
    team.learn(120)
    trained = {agent: model.policy.history for agent, model in team.agents.items()}

    env = make_team_env(make, n_envs=3, seed=seed)
    other = Team(BeliefPPO, "BeliefPolicy", env, seed=0, **kwargs)
    env.seed(seed)
    with observing(other, env) as watched:
        watched.reset()
        for actions in played[-40:]:
            watched.step(actions)
        for agent, model in other.agents.items():
            history = model.policy.history
            assert watched.steps[agent] == int(history.valid.sum()) == int(trained[agent].valid.sum())
            assert th.equal(history.observations, trained[agent].observations)
            assert th.equal(history.actions, trained[agent].actions)


@pytest.mark.parametrize("make", [BlinkingEnv, ScriptedEnv])
def test_time_passes_as_in_a_training(make):
    """Also in steps in which an agent is in play in no copy, so that the age of what it has seen means the same."""
    team = Team(BeliefPPO, "BeliefPolicy", make_team_env(make, n_envs=1, seed=0), seed=0, **{**BELIEF, "belief": "adaptive"})
    with observing(team, team.env) as watched:
        watched.reset()
        for k in range(12):
            watched.is_open = k < 10
            watched.step({agent: np.zeros((1, *space.shape), space.dtype) for agent, space in team.env.action_space.items()})
        clocks = {agent: model.policy.features_extractor.clock for agent, model in team.agents.items()}
        assert clocks == dict.fromkeys(team.agents, 10)


def test_nobody_learns_while_observing():
    env = make_team_env(ToyEnv, n_envs=2, seed=0)
    team = Team(BeliefPPO, "BeliefPolicy", env, seed=0, **BELIEF)
    with observing(team, make_team_env(ToyEnv, n_envs=2, seed=1)) as watched:
        watched.reset()
        with pytest.raises(ValueError, match="learn\\(\\) within observing"):
            team.learn(64)
    team.learn(64)


def test_normalised_agents_remember_what_they_see():
    env = make_team_env(ToyEnv, n_envs=2, seed=0)
    team = Team(BeliefPPO, "BeliefPolicy", env, seed=0, normalize=True, **BELIEF).learn(64)
    with observing(team, env) as watched:
        obs = watched.reset()
        watched.step({agent: np.zeros(2, dtype=int) for agent in team.agents})
        for agent, model in team.agents.items():
            rows = model.policy.history.observations[model.policy.history.valid][-2:]
            np.testing.assert_array_equal(rows, team.observed_by(agent, obs[agent]))
            assert not np.array_equal(rows, obs[agent])


def test_a_number_of_steps_is_exact_and_an_error_restores_too():
    env = make_team_env(ToyEnv, n_envs=4, seed=0)
    team = Team(BeliefPPO, "BeliefPolicy", env, seed=0, **BELIEF)
    before = state(team)
    with pytest.raises(KeyError), observing(team, env, most_steps=10) as watched:
        watched.reset()
        counts = []
        for k in range(6):
            watched.is_open = k != 1
            watched.step({agent: np.zeros(4, dtype=int) for agent in team.agents})
            counts.append(watched.steps["agent_0"])
        assert counts == [4, 4, 8, 10, 10, 10] and state(team) != before
        raise KeyError
    assert state(team) == before
    # Not after the block, either
    watched.reset()
    watched.step({agent: np.zeros(4, dtype=int) for agent in team.agents})
    assert state(team) == before


def test_a_single_model_observes_in_an_agent_env():
    kwargs = {"parallel_env": "convention-swap", "agent": "follower", "partners": {}}
    env = make_vec_env(AgentEnv, n_envs=3, seed=0, env_kwargs=kwargs)
    model = BeliefPPO("BeliefPolicy", env, seed=0, **BELIEF).learn(24)
    policy: Any = model.policy
    before = policy.history
    with observing(model, env) as watched:
        obs = watched.reset()
        infos = watched.step(np.array([0, 1, 2]))[3]
        history = policy.history
        rows = history.observations[history.valid][-3:]
        np.testing.assert_array_equal(rows.argmax(dim=1), obs)
        np.testing.assert_array_equal(history.actions[history.valid][-3:], [info["others_actions"] for info in infos])
        evaluate_policy(model, watched, n_eval_episodes=6)
        assert watched.steps == {"follower": 3 + 2 * 3 * 16}
    assert all(th.equal(old, new) for old, new in zip(before, policy.history, strict=True))


def test_a_single_model_observes_as_vec_normalize_shows_it():
    env: Any = make_vec_env(
        AgentEnv, n_envs=2, seed=0, env_kwargs={"parallel_env": BlinkingEnv, "agent": "arrow", "partners": {"ball": _still}}
    )
    env = VecNormalize(env)
    model = BeliefPPO("BeliefPolicy", env, seed=0, **BELIEF).learn(16)
    with observing(model, env) as watched:
        obs = watched.reset()
        watched.step(np.array([0, 1]))
        policy: Any = model.policy
        history = policy.history
        np.testing.assert_array_equal(history.observations[history.valid][-2:], obs)


def _still(obs):
    return np.zeros(1, dtype=np.float32)


def test_masks_reach_the_agents_of_an_observed_environment():
    from sb3_belief import MaskableBeliefPPO

    class AllMasked(MaskedEnv):
        """Masks for everyone."""

        def __init__(self):
            super().__init__(n_agents=3)
            self.possible_agents = self.possible_agents[:2]

    env = make_team_env(AllMasked, n_envs=2, seed=0)
    team = Team(MaskableBeliefPPO, "BeliefPolicy", env, seed=0, **BELIEF)
    with observing(team, env) as watched:
        assert len(evaluate(team, watched, 4).returns) == 4
        assert watched.steps["agent_0"] == 4 * 7


def test_refused():
    env = make_team_env(ToyEnv, n_envs=2)
    team = Team(BeliefPPO, "BeliefPolicy", env, seed=0, **BELIEF)
    plain = Team(PPO, "MlpPolicy", env, seed=0, **PPO_KWARGS)
    static = Team(BeliefPPO, "BeliefPolicy", env, seed=0, belief="static", **PPO_KWARGS)
    for model, given, error, message in (
        (plain, env, ValueError, "Nobody here has a belief.*agent_0: PPO"),
        (static, env, ValueError, "Nobody here has a belief"),
        (team, make_team_env(ScriptedEnv), ValueError, "the environment"),
        (team.agents["agent_0"], env, TypeError, "environment of a team"),
        (evaluate_policy, env, TypeError, "A Team or an SB3 model"),
    ):
        with pytest.raises(error, match=message), observing(model, given):
            pass
    for most_steps in (-1, 0.5, True):
        with pytest.raises(ValueError, match="most_steps"), observing(team, env, most_steps):
            pass
    with observing(team, env) as watched, pytest.raises(RuntimeError, match="has to be reset"):
        watched.step({agent: np.zeros(2, dtype=int) for agent in team.agents})


def test_some_agents_observe_and_for_longer_as_it_goes_on():
    env = make_team_env(ToyEnv, n_envs=2, seed=0)
    team = Team(BeliefPPO, "BeliefPolicy", env, seed=0, **BELIEF)
    others = [agent for agent in team.agents if agent != "agent_0"]
    before = {agent: team.agents[agent].policy.history for agent in team.agents}
    with observing(team, env, most_steps=1, agents=["agent_0"]) as watched:
        watched.reset()
        for most, counted in ((1, 1), (4, 3), (4, 4)):
            watched.most_steps = most
            watched.step({agent: np.zeros(2, dtype=int) for agent in team.agents})
            assert watched.steps == {"agent_0": counted}
        assert all(team.agents[agent].policy.history.actions is before[agent].actions for agent in others)
    with pytest.raises(ValueError, match=r"unknown agents .*nobody"), observing(team, env, agents=["nobody"]):
        pass
