"""TeamVecEnv: infos, monitoring, checks and worker processes."""

from functools import partial

import numpy as np
import pytest
from gymnasium import spaces
from mpe2 import simple_spread_v3
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_belief.team import JointEnv
from tests.team.helpers import make_team_env
from tests.team.toy_envs import FaultyEnv, MaskedEnv, MixedEnv, PartneredEnv, ScriptedEnv, ToyEnv

ZEROS = {agent: np.zeros(1, int) for agent in ("stays", "dies", "cut", "last")}


def scripted_episode(**kwargs):
    """Return a ``ScriptedEnv`` and the eight steps of its first episode."""
    env = make_team_env(ScriptedEnv, **kwargs)
    env.reset()
    return env, [env.step(ZEROS) for _ in range(8)]


@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_infos_of_every_way_to_end(vec_env):
    env, steps = scripted_episode(vec_env=vec_env)
    infos = [step[3][0] for step in steps]
    flags = {
        key: np.array([info[key] for info in infos]).T.astype(int).tolist() for key in ("active", "life_end", "truncated")
    }
    # Rows are the agents stays, dies, cut and last, columns the eight steps
    assert flags["active"] == [[1, 1, 1, 0, 0, 1, 1, 1], [1] * 5 + [0] * 3, [1] * 6 + [0] * 2, [1] * 8]
    assert flags["life_end"] == [[0, 0, 1, 0, 0, 0, 0, 0], [0, 0, 0, 0, 1, 0, 0, 0], [0] * 8, [0] * 8]
    assert flags["truncated"] == [[0] * 7 + [1], [0] * 8, [0] * 5 + [1, 0, 0], [0] * 7 + [1]]
    assert [bool(step[2][0]) for step in steps] == [False] * 7 + [True]
    # By default an action is visible if both agents are in play
    assert infos[3]["visible"].tolist() == [[False] * 3, [False, True, True], [False, True, True], [False, True, True]]
    for t, (info, step) in enumerate(zip(infos, steps, strict=True), start=1):
        expected = [1 + 10 * i + t / 100 for i in range(4)]
        assert info["agent_rewards"].dtype == np.float32
        assert info["agent_rewards"] == pytest.approx(expected)
        assert step[1].dtype == np.float32 and step[1][0] == pytest.approx(np.mean(expected))
    last = infos[-1]
    assert last["TimeLimit.truncated"] is True and last["is_success"] is False
    assert last["terminal_observation"]["last"].tolist() == [8, 10]
    assert last["terminal_observation"]["dies"].tolist() == [0, 0]
    assert last["episode"]["l"] == 8
    assert last["episode"]["r"] == pytest.approx(sum(np.mean(info["agent_rewards"]) for info in infos))
    assert last["agent_episode_rewards"] == pytest.approx(np.sum([info["agent_rewards"] for info in infos], axis=0), rel=1e-6)
    assert steps[-1][0]["last"].tolist() == [[0, 20]]
    env.close()


def test_who_has_left_observes_zero():
    _, steps = scripted_episode()
    # "dies" leaves at step 5. An agent that is cut off has its last observation in the infos, for the value at the limit
    assert [step[0]["dies"][0].tolist() for step in steps[3:7]] == [[4, 10], [0, 0], [0, 0], [0, 0]]
    assert steps[5][3][0]["terminal_observation"] == {"cut": pytest.approx(np.array([6, 10]))}
    assert [step[0]["last"][0, 0] for step in steps[4:7]] == [5, 6, 7]


def test_team_reward_of_the_environment():
    class Best(ToyEnv):
        def team_reward(self, rewards):
            return max(rewards.values())

    env = make_team_env(Best)
    env.reset()
    _, reward, _, infos = env.step({"agent_0": [0], "agent_1": [2]})
    assert reward[0] == infos[0]["agent_rewards"].max() != infos[0]["agent_rewards"].mean()


def test_workers_equal_in_process():
    rng = np.random.default_rng(0)
    actions = [{agent: rng.integers(0, 5, 3) for agent in ("agent_0", "agent_1", "agent_2")} for _ in range(30)]
    runs = []
    for vec_env in ("dummy", "subproc"):
        env = make_team_env(simple_spread_v3.parallel_env, n_envs=3, seed=5, vec_env=vec_env)
        first = env.reset()
        runs.append([(first, None, None, None), *(env.step(a) for a in actions)])
        env.close()
    for (obs, rewards, dones, infos), (obs2, rewards2, dones2, infos2) in zip(*runs, strict=True):
        assert all(np.array_equal(obs[agent], obs2[agent]) and obs[agent].dtype == obs2[agent].dtype for agent in obs)
        if infos is None:
            continue
        assert np.array_equal(rewards, rewards2) and np.array_equal(dones, dones2)
        for info, info2 in zip(infos, infos2, strict=True):
            assert all(np.array_equal(info[key], info2[key]) for key in ("agent_rewards", "visible", "active", "truncated"))
    assert runs[0][25][2].all() and runs[0][25][3][0]["TimeLimit.truncated"]
    # Copy i has the seed 5 + i
    env = make_team_env(simple_spread_v3.parallel_env, n_envs=1, seed=6)
    assert np.array_equal(env.reset()["agent_1"][0], runs[0][0][0]["agent_1"][1])


class Sensitive(MixedEnv):
    """A ``MixedEnv`` whose rewards depend on the value, the dtype and the Python type of the action."""

    def step(self, actions):
        obs, _, *rest = super().step(actions)
        kinds = {int: 0.25, np.ndarray: 0.5}
        rewards = {agent: float(np.sum(action, dtype=np.float64)) + kinds[type(action)] for agent, action in actions.items()}
        sizes = {agent: np.asarray(action).dtype.itemsize for agent, action in actions.items()}
        return obs, {agent: reward + 64 * sizes[agent] for agent, reward in rewards.items()}, *rest


def same(one, other):
    """Assert that two results are equal to the bit, including keys and types."""
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one.keys() - {"t"}:
            same(one[key], other[key])
    else:
        assert type(one) is type(other)
        assert np.array_equal(one, other) and np.asarray(one).dtype == np.asarray(other).dtype


@pytest.mark.parametrize("env_class", [ToyEnv, Sensitive, ScriptedEnv, PartneredEnv, partial(MaskedEnv, n_agents=3, limit=4)])
def test_what_workers_send_equals_what_copies_here_return(env_class):
    here, there = (make_team_env(env_class, n_envs=3, seed=2, vec_env=vec_env) for vec_env in ("dummy", "subproc"))
    same(here.reset(), there.reset())
    rng = np.random.default_rng(0)
    for _ in range(20):
        actions = {}
        for agent, space in here.action_space.spaces.items():
            space.seed(int(rng.integers(1000)))
            actions[agent] = np.array([space.sample() for _ in range(3)])
            if isinstance(space, spaces.Box):
                # A dtype other than the space's
                actions[agent] = np.float64(0.999) * actions[agent]
        for agent, mask in (here.action_masks() or {}).items():
            actions[agent] = mask.argmax(axis=1)
        (obs, rewards, dones, infos), (obs2, rewards2, dones2, infos2) = here.step(actions), there.step(actions)
        same({"obs": obs, "rewards": rewards, "dones": dones}, {"obs": obs2, "rewards": rewards2, "dones": dones2})
        for info, info2 in zip(infos, infos2, strict=True):
            same(info, info2)
        if (masks := here.action_masks()) is not None:
            same(masks, there.action_masks())
    # Arrays that a step has returned do not change later, and may be written to
    kept = [array.copy() for array in obs2.values()]
    there.step(actions)
    assert all(np.array_equal(array, copy) for array, copy in zip(obs2.values(), kept, strict=True))
    assert all(array.flags.writeable for array in obs2.values())
    there.close()


def test_seed_is_used_once():
    env = make_team_env(ToyEnv, n_envs=2, seed=1)
    first, second = env.reset(), env.reset()
    assert not np.array_equal(first["agent_0"], second["agent_0"])
    env.seed(1)
    assert np.array_equal(env.reset()["agent_0"], first["agent_0"])


@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_asking_for_what_an_environment_lacks_harms_nobody(vec_env):
    env = make_team_env(partial(ToyEnv, n_agents=2), n_envs=2, seed=0, vec_env=vec_env)
    assert env.has_attr("positions") and env.has_attr("action_masks") and not env.has_attr("versions")
    env.reset()
    assert set(env.get_attr("positions")[1]) == {"agent_0", "agent_1"}
    env.close()


def test_observations_are_not_overwritten():
    class Frugal(ToyEnv):
        def observations(self):
            self.buffers = getattr(self, "buffers", {agent: np.zeros(2, np.float32) for agent in self.possible_agents})
            for agent in self.agents:
                self.buffers[agent][:] = self.positions[agent]
            return {agent: self.buffers[agent] for agent in self.agents}

    env = make_team_env(partial(Frugal, limit=2))
    action = {"agent_0": [0], "agent_1": [0]}
    first = env.reset()
    kept = first["agent_0"].copy()
    env.step(action)
    _, _, _, infos = env.step(action)
    terminal = infos[0]["terminal_observation"]["agent_0"].copy()
    env.step(action)
    assert np.array_equal(first["agent_0"], kept)
    assert np.array_equal(infos[0]["terminal_observation"]["agent_0"], terminal)


@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_masks_are_those_of_the_current_observation(vec_env):
    env = make_team_env(partial(MaskedEnv, n_agents=3, limit=4), n_envs=2, vec_env=vec_env)
    env.reset()
    for step in range(10):
        t = step % 4
        masks = env.action_masks()
        assert masks["agent_0"].dtype == bool and masks["agent_0"].shape == (2, 3)
        assert masks["agent_0"].tolist() == [[i == t % 3 for i in range(3)]] * 2
        assert masks["agent_1"].tolist() == [[i == (t + 1) % 3 for i in range(3)]] * 2
        assert masks["agent_2"].all()
        _, _, _, infos = env.step({f"agent_{i}": np.full(2, (t + i) % 3) for i in range(3)})
        assert "action_masks" not in infos[0]
    env.close()
    assert make_team_env(ToyEnv).action_masks() is None


def test_evaluate_policy_trusts_the_built_in_monitor(recwarn):
    class Still:
        def predict(self, obs, state=None, episode_start=None, deterministic=False):
            return {agent: np.ones(len(part), int) for agent, part in obs.items()}, None

    env = make_team_env(ToyEnv, n_envs=2, seed=0)
    rewards, lengths = evaluate_policy(Still(), env, n_eval_episodes=4, return_episode_rewards=True)
    assert lengths == [7] * 4 and len(np.unique(rewards)) == 4
    assert not [w for w in recwarn if "Monitor" in str(w.message)]


@pytest.mark.parametrize(
    "actions, says",
    [
        (np.zeros((2, 2)), "a dict"),
        ({"agent_0": [0, 0]}, r"missing \['agent_1'\]"),
        ({"agent_0": [0, 0], "agent_1": [0, 0], "agent_7": [0, 0]}, r"unknown \['agent_7'\]"),
        ({"agent_0": [0, 0], "agent_1": [0]}, r"'agent_1' must have the shape \(2,\)"),
        ({"agent_0": [0, 0], "agent_1": [[0], [0]]}, r"got \(2, 1\)"),
    ],
)
def test_wrong_actions(actions, says):
    env = make_team_env(ToyEnv, n_envs=2)
    env.reset()
    with pytest.raises(ValueError, match=says):
        env.step(actions)


class SpaceEnv(ToyEnv):
    """A ``ToyEnv`` with other spaces."""

    def __init__(self, observation_space=None, action_space=None):
        super().__init__()
        self.given = observation_space, action_space

    def observation_space(self, agent):
        return self.given[0] or super().observation_space(agent)

    def action_space(self, agent):
        return self.given[1] or super().action_space(agent)


@pytest.mark.parametrize(
    "given, says",
    [
        ({"observation_space": spaces.Dict({"x": spaces.Text(2)})}, "'agent_0' is Dict.*Text.*; allowed are Discrete"),
        ({"observation_space": spaces.Tuple([spaces.Text(2)])}, "'agent_0' is Dict.'0'.*; allowed are Discrete"),
        ({"action_space": spaces.Tuple([spaces.Discrete(2)])}, "allowed are Discrete, MultiDiscrete, MultiBinary, Box"),
        ({"action_space": spaces.Discrete(3, start=1)}, "start"),
    ],
)
def test_spaces_that_are_refused(given, says):
    with pytest.raises(ValueError, match=says):
        make_team_env(SpaceEnv, env_kwargs=given)


def test_make_team_env_refuses_what_it_cannot_use():
    with pytest.raises(TypeError, match="callable that makes a ParallelEnv, got ToyEnv"):
        make_team_env(ToyEnv())
    with pytest.raises(TypeError, match=r"sb3_belief\.envs\.to_parallel"):
        make_team_env(simple_spread_v3.env)
    with pytest.raises(ValueError, match="'dummy' or 'subproc', got 'thread'"):
        make_team_env(ToyEnv, vec_env="thread")
    with pytest.raises(ValueError, match="at least 1, got 0"):
        make_team_env(ToyEnv, n_envs=0)
    with pytest.raises(ValueError, match="Unknown environment id"):
        make_team_env("no-such-env")


def test_wrapper_and_env_kwargs():
    seen = []

    def wrapper(env):
        seen.append(env)
        env.limit += 1
        return env

    env = make_team_env(ToyEnv, n_envs=2, env_kwargs={"n_agents": 3, "limit": 4}, wrapper=wrapper)
    assert env.possible_agents == ["agent_0", "agent_1", "agent_2"] and len(seen) == 2
    assert env.get_attr("limit") == [5, 5]
    env.set_attr("limit", 9)
    assert [copy.limit for copy in seen] == [9, 9]


def test_render_tiles_the_copies():
    env = make_team_env(partial(ToyEnv, render_mode="rgb_array"), n_envs=4)
    env.reset()
    env.step({"agent_0": [0] * 4, "agent_1": [0] * 4})
    assert env.render_mode == "rgb_array"
    assert env.render().shape == (8, 8, 3) and (env.render() == 1).all()


def test_order_is_the_environments_not_the_alphabets():
    env = make_team_env(MixedEnv)
    assert env.possible_agents == ["zeta", "box", "multi", "binary"]
    obs = env.reset()
    assert obs["binary"].shape == (1, 2, 2) and obs["multi"].shape == (1,)
    actions = {"zeta": [2], "box": [[0.5, -1]], "multi": [[1, 2]], "binary": [[1, 1]]}
    _, _, _, infos = env.step(actions)
    assert infos[0]["agent_rewards"].tolist() == [2.0, -0.5, 3.0, 2.0]
    # At step 1 agent i sees agent j where i + j is odd
    expected = [[True, False, True], [True, True, False], [False, True, True], [True, False, True]]
    assert infos[0]["visible"].tolist() == expected


def test_joint_env_alone():
    env = JointEnv(ToyEnv())
    obs, _ = env.reset(seed=3)
    assert env.observation_space.contains(obs)
    for _ in range(7):
        *_, terminated, truncated, _ = env.step({"agent_0": 1, "agent_1": 1})
    assert (terminated, truncated) == (False, True)


def test_worker_that_dies_is_named():
    def make():
        return FaultyEnv("exit")

    env = make_team_env(make, n_envs=2, vec_env="subproc")
    env.reset()
    action = {"agent_0": [0, 0], "agent_1": [0, 0]}
    with pytest.raises(RuntimeError) as caught:
        for _ in range(20):
            env.step(action)
    for copy in (0, 1):
        told = f"worker process {copy} (exit code 3) died during step() in environment copy {copy} at step 3"
        assert told in str(caught.value)
    assert not any(process.is_alive() for process in env.venv.processes)
    with pytest.raises(RuntimeError, match="closed"):
        env.reset()
    env.close()
