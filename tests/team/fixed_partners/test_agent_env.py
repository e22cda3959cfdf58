"""One learner among fixed partners gets the same observations, rewards, dones and infos as in a Team."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from mpe2 import simple_spread_v3
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_belief.envs import TrafficJunction
from sb3_belief.team.lockstep.joint_loop import JointLoop
from tests.team.fixed_partners.helpers import AgentEnv, one, toy, zero
from tests.team.helpers import make_team_env
from tests.team.toy_envs import BlinkingEnv, MixedEnv, ScriptedEnv, ToyEnv


class Playback:
    """
    Partner whose actions are given in advance.

    :param actions: One action for each step
    """

    def __init__(self, actions):
        self.actions = iter(actions)

    def __call__(self, obs):
        return next(self.actions)


def spread():
    """Make a ``simple_spread`` of three agents and seven steps."""
    return simple_spread_v3.parallel_env(N=3, max_cycles=7)


def sampled(env, n_steps, seed=5):
    """Return random actions by agent for one copy of a team's environment, one for each step."""
    rng = np.random.default_rng(seed)
    actions: dict[str, list] = {}
    for agent in env.possible_agents:
        space = env.action_space[agent]
        space.seed(int(rng.integers(2**31)))
        actions[agent] = [np.asarray(space.sample()) for _ in range(n_steps)]
    return actions


def team_steps(make, agent, actions, n_steps):
    """Return the first observation and the transitions that the agent gets in a team."""
    env = make_team_env(make, n_envs=1, seed=11)
    loop = JointLoop(env)
    first = env.reset()[agent]
    transitions = []
    for t in range(n_steps):
        joint = {name: column[t][None] for name, column in actions.items()}
        transitions.append(loop._splitter.split(joint, env.step(joint))[env.possible_agents.index(agent)])
    env.close()
    return first, transitions


ENVS: dict[str, tuple[Any, list[str]]] = {
    "toy": (toy(), ["agent_0", "agent_2"]),
    "mixed": (MixedEnv, ["zeta", "multi", "binary"]),
    "blinking": (BlinkingEnv, ["arrow"]),
    "life_end": (ScriptedEnv, ["stays", "last"]),
    "traffic": (partial(TrafficJunction, "easy", arrival_rate=0.3), ["car_0", "car_3"]),
    "spread": (spread, ["agent_0", "agent_1"]),
}


CASES = [pytest.param(make, agent, id=f"{name}-{agent}") for name, (make, agents) in ENVS.items() for agent in agents]


@pytest.mark.parametrize("make, agent", CASES)
def test_the_learner_meets_what_it_meets_in_a_team(make, agent):
    n_steps = 90
    template = make_team_env(make, n_envs=1)
    actions = sampled(template, n_steps)
    first, transitions = team_steps(make, agent, actions, n_steps)

    partners = {name: Playback(column) for name, column in actions.items() if name != agent}
    env: Any = DummyVecEnv([lambda: AgentEnv(make, agent, partners)])
    others = template.get_attr("action_spaces")[0] | template.scripted_action_spaces
    assert list(env.get_attr("others_action_spaces")[0].items()) == [(k, v) for k, v in others.items() if k != agent]
    env.seed(11)
    assert np.array_equal(env.reset(), first)
    n_dones = n_cut = 0
    for action, (obs, rewards, dones, infos) in zip(actions[agent], transitions, strict=True):
        found_obs, found_rewards, found_dones, found_infos = env.step(action[None])
        assert found_obs.dtype == obs.dtype and np.array_equal(found_obs, obs)
        assert found_rewards.dtype == rewards.dtype and np.array_equal(found_rewards, rewards)
        assert np.array_equal(found_dones, dones)
        info, found = dict(infos[0]), found_infos[0]
        # A Monitor writes the entry here, and counts from the learner's last reset
        info.pop("episode", None)
        # SB3's vectorised environments set the entry at every step
        info.setdefault("TimeLimit.truncated", False)
        # Here each episode of the learner has it, also one that ends before the team's
        if dones[0] and "is_success" in found:
            assert found["is_success"] is info.setdefault("is_success", False)
        assert found.keys() == info.keys()
        for key, value in info.items():
            assert np.array_equal(found[key], value), key
        for key in ("others_actions", "others_visible"):
            assert found[key].dtype == info[key].dtype and found[key].shape == info[key].shape
        n_dones, n_cut = n_dones + int(dones[0]), n_cut + int(info["TimeLimit.truncated"])
    # MixedEnv terminates, all others are truncated
    assert n_dones >= 4 and (n_cut > 0) == (make is not MixedEnv)
    env.close()


@pytest.mark.parametrize("agent, last, cut", [("dies", 5, False), ("cut", 6, True)])
def test_a_learner_that_has_left_does_not_wait_for_the_others(agent, last, cut):
    """Up to where it leaves its steps are as in a Team. Of the rest of the episode it gets only whether it succeeded."""
    n_steps = 3 * 8
    template = make_team_env(ScriptedEnv, n_envs=1)
    actions = sampled(template, n_steps)
    _, transitions = team_steps(ScriptedEnv, agent, actions, n_steps)
    partners = {name: Playback(column) for name, column in actions.items() if name != agent}
    env = AgentEnv(ScriptedEnv, agent, partners)
    for episode in range(3):
        obs, _ = env.reset(seed=11 if episode == 0 else None)
        assert obs.tolist() == [0, 10 * (episode + 1)]
        for t in range(last):
            k = 8 * episode + t
            obs, reward, terminated, truncated, info = env.step(actions[agent][k])
            _, rewards, dones, infos = transitions[k]
            assert reward == rewards[0] and (terminated or truncated) == dones[0] and truncated == (cut and t == last - 1)
            assert np.array_equal(info["others_actions"], infos[0]["others_actions"]) and info["active"]
        assert (terminated or truncated) and obs.tolist() == [last, 10 * (episode + 1)]
        assert info["is_success"] == (episode % 2 == 1)


def test_a_dead_partner_is_neither_seen_nor_told():
    env = AgentEnv(ScriptedEnv, "last", {"stays": one, "dies": one, "cut": one})
    env.reset(seed=0)
    seen = []
    for t in range(1, 9):
        _, _, terminated, truncated, info = env.step(0)
        seen.append(info["others_visible"].tolist())
        assert info["others_actions"].tolist() == [x for s in seen[-1] for x in ([0.0, 1.0] if s else [0.0, 0.0])]
        assert not terminated and truncated == (t == 8)
    stays, dies, cut = zip(*seen, strict=True)
    assert stays == (True, True, True, False, False, True, True, True)
    assert dies == (True,) * 5 + (False,) * 3 and cut == (True,) * 6 + (False,) * 2


def test_after_its_own_end_reset_goes_on_unless_it_is_told_otherwise():
    env = AgentEnv(ScriptedEnv, "stays", {"dies": one, "cut": one, "last": one})
    env.reset(seed=0)
    for _ in range(3):
        _, _, terminated, _, _ = env.step(0)
    assert terminated
    assert env.reset()[0].tolist() == [3, 10]
    assert env.step(0)[0].tolist() == [4, 10]
    # In the middle of an episode, or with a seed or options, reset() begins a new episode
    assert env.reset()[0].tolist() == [0, 20]
    for _ in range(3):
        env.step(0)
    assert env.reset(seed=1)[0].tolist() == [0, 30]
    for _ in range(3):
        env.step(0)
    assert env.reset(options={"a": 1})[0].tolist() == [0, 40]


@pytest.mark.filterwarnings("error")  # Including the one that the matrix observation of "binary" causes
@pytest.mark.parametrize("make, agent", [case.values for case in CASES if case.id != "mixed-binary"] + [(ScriptedEnv, "dies")])
def test_sb3_finds_nothing_wrong_with_it(make, agent):
    spaces = make_team_env(make, n_envs=1).action_space
    partners = {name: partial(_sample, space) for name, space in spaces.items() if name != agent}
    check_env(AgentEnv(make, agent, partners))


def _sample(space, obs):
    return space.sample()


def test_order_of_calls():
    env = AgentEnv(toy(2), "agent_0", {"agent_1": zero})
    with pytest.raises(RuntimeError, match=r"call reset\(\) first"):
        env.step(0)
    env.reset()
    for _ in range(7):
        env.step(0)
    with pytest.raises(RuntimeError, match="'agent_0' is over"):
        env.step(0)
    env.close()


@pytest.mark.parametrize(
    "agent, partners, kwargs, error, message",
    [
        ("agent_0", {"agent_1": zero}, {}, ValueError, r"\['agent_2'\] of this environment have no partner"),
        ("agent_0", {}, {}, ValueError, r"\['agent_1', 'agent_2'\] .* no partner .* each of \['agent_1', 'agent_2'\]"),
        ("agent_9", {}, {}, ValueError, r"no agent 'agent_9' to learn; the environment has \['agent_0', "),
        ("agent_0", {"agent_0": zero, "agent_1": zero, "agent_2": zero}, {}, ValueError, "'agent_0' is the learner"),
        ("agent_0", {"agent_1": zero, "agent_2": zero, "bob": zero}, {}, ValueError, "'bob' is not an agent"),
        ("agent_0", {"agent_1": zero, "agent_2": 3}, {}, TypeError, "The partner 'agent_2' is 3; it must be"),
        ("agent_0", {"agent_1": zero, "agent_2": PPO}, {}, TypeError, "it must be an SB3 model"),
        ("agent_0", [zero, zero], {}, TypeError, r"a dict \{agent: partner\}"),
        ("agent_0", {"agent_1": zero, "agent_2": "nowhere.zip"}, {}, FileNotFoundError, "no 'nowhere.zip'"),
        ("agent_0", {"agent_1": zero, "agent_2": zero}, {"visibility": 3}, TypeError, "callable"),
    ],
)
def test_wrong_input(agent, partners, kwargs, error, message):
    with pytest.raises(error, match=message):
        env = AgentEnv(toy(), agent, partners, **kwargs)
        env.reset()
        env.step(0)


def test_wrong_environments():
    with pytest.raises(ValueError, match=r"'limit'.*made already"):
        AgentEnv(ToyEnv(), "agent_0", {"agent_1": zero}, env_kwargs={"limit": 3})
    with pytest.raises(TypeError, match=r"needs a pettingzoo.ParallelEnv, got int"):
        AgentEnv(3, "agent_0", {})
    with pytest.raises(ValueError, match="Unknown environment id"):
        AgentEnv("nothing-like-it", "agent_0", {})


def test_wrong_partners_in_play():
    env = AgentEnv(toy(2), "agent_0", {"agent_1": lambda obs: 7})
    env.reset()
    with pytest.raises(ValueError, match=r"The action of 'agent_1' .* is 7"):
        env.step(0)

    class Odd:
        def predict(self, obs, state=None, episode_start=None, deterministic=False):
            return 1

    env.set_partner("agent_1", Odd())
    with pytest.raises(TypeError, match=r"predict\(\) of the partner 'agent_1' returned 1"):
        env.step(0)


def test_ids_instances_and_lone_learners():
    partners = {f"car_{i}": zero for i in (0, 2, 3, 4)}
    env = AgentEnv("traffic-junction-easy", "car_1", partners, env_kwargs={"arrival_rate": 0.5}, render_mode="rgb_array")
    assert env.parallel_env.unwrapped.render_mode == "rgb_array"
    env.reset(seed=0)
    assert env.render().ndim == 3
    assert list(env.others_action_spaces) == ["car_0", "car_2", "car_3", "car_4"]
    made = ToyEnv(2)
    assert AgentEnv(made, "agent_1", {"agent_0": zero}).parallel_env is made
    lone = AgentEnv(toy(1), "agent_0", {})
    lone.reset(seed=0)
    assert lone.step(1)[4]["others_actions"].shape == (0,)


def test_visibility_given_by_the_user():
    def nobody(env):
        return {agent: np.zeros(1, bool) for agent in env.possible_agents}

    env = AgentEnv(toy(2), "agent_0", {"agent_1": one}, visibility=nobody)
    env.reset(seed=0)
    info = env.step(0)[4]
    assert not info["others_visible"].any() and not info["others_actions"].any()
