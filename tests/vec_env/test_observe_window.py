"""Windows of the last observations: what is in them at the beginning, at every end, and after a resume."""

import numpy as np
import pytest
from gymnasium import spaces

from sb3_belief.baselines import IQL
from tests.team.helpers import Team, make_team_env
from tests.team.toy_envs import ScriptedEnv, ToyEnv


def steps_of(window):
    """Return the steps that a window of a ``ScriptedEnv`` shows, 0 for the zeros before an episode and for its first row."""
    return window[:, 0].astype(int).tolist()


def test_the_window_of_each_agent_begins_with_its_own_episode():
    env = make_team_env(ScriptedEnv, n_envs=1, seed=0, observe_window=3)
    assert env.observation_space["last"].shape == (3, 2)
    obs = env.reset()
    # Row [step, 10 * episode]
    assert obs["last"][0].tolist() == [[0, 0], [0, 0], [0, 10]]
    seen: dict[str, list[list[int]]] = {agent: [] for agent in env.possible_agents}
    last: dict[tuple[str, int], list[int]] = {}
    for t in range(1, 9):
        obs, _, _, infos = env.step({agent: np.zeros(1, int) for agent in env.possible_agents})
        for agent in seen:
            assert obs[agent][0] in env.observation_space[agent]
            seen[agent].append(steps_of(obs[agent][0]))
            if agent in infos[0].get("terminal_observation", {}):
                last[agent, t] = steps_of(infos[0]["terminal_observation"][agent])
    assert seen["last"] == [[0, 0, 1], [0, 1, 2], [1, 2, 3], [2, 3, 4], [3, 4, 5], [4, 5, 6], [5, 6, 7], [0, 0, 0]]
    # Its life ends at step 3: the next one begins with what it sees then
    assert seen["stays"][1:5] == [[0, 1, 2], [0, 0, 3], [0, 3, 4], [3, 4, 5]]
    assert last["stays", 3] == [1, 2, 3] and last["last", 8] == [6, 7, 8] and last["cut", 6] == [4, 5, 6]
    # The first observation of the next episode
    assert obs["last"][0].tolist() == [[0, 0], [0, 0], [0, 20]]


def test_discrete_observations_are_one_hot_and_others_stay_as_they_are():
    env = make_team_env("convention-swap", n_envs=2, seed=0, observe_window=2)
    obs = env.reset()
    assert obs["follower"].shape == (2, 2, 4) and obs["follower"].sum(axis=-1).tolist() == [[0, 1]] * 2
    some = make_team_env(ToyEnv, n_envs=2, seed=0, observe_window={"agent_1": 3})
    obs = some.reset()
    assert obs["agent_0"].shape == (2, 2) and obs["agent_1"].shape == (2, 3, 2)


def test_a_resume_goes_on_with_the_window():
    first, second = (make_team_env(ToyEnv, n_envs=2, seed=seed, observe_window=3) for seed in (0, 9))
    first.reset()
    second.reset()
    actions = {agent: np.ones(2, int) for agent in first.possible_agents}
    for _ in range(4):
        first.step(actions)
    second.set_exact_state(first.exact_state())
    for _ in range(5):
        a, b = first.step(actions)[0], second.step(actions)[0]
        assert all(np.array_equal(a[agent], b[agent]) for agent in a)


def test_kept_observations_do_not_change():
    env = make_team_env(ToyEnv, n_envs=2, seed=0, observe_window=3)
    kept = env.reset()["agent_0"]
    before = kept.copy()
    for _ in range(8):
        env.step({agent: np.ones(2, int) for agent in env.possible_agents})
    assert np.array_equal(kept, before)


def test_a_limit_is_valued_by_the_last_window():
    team = Team(IQL, "MlpPolicy", make_team_env(ToyEnv, n_envs=1, seed=0, observe_window=3), seed=0, learning_starts=10**6)
    buffer = team.learn(14).agents["agent_0"].replay_buffer
    # The window after step 7 goes on from the one before; the next row is of the next episode
    assert np.array_equal(buffer.next_observations[6, 0][:2], buffer.observations[6, 0][1:]) and buffer.timeouts[6, 0]
    assert not buffer.observations[7, 0][:2].any()


@pytest.mark.parametrize("window", [-1, True, 1.5, {"agent_0": 0}, {"nobody": 2}])
def test_wrong_windows(window):
    with pytest.raises(ValueError, match="observe_window"):
        make_team_env(ToyEnv, observe_window=window)


def test_images_and_dicts_have_no_windows():
    class Parts(ToyEnv):
        def observation_space(self, agent):
            return spaces.Dict({"a": spaces.Box(0, 1, (2,))})

    with pytest.raises(ValueError, match="no windows"):
        make_team_env(Parts, observe_window=2)
