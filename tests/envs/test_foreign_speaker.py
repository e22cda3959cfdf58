"""The foreign speaker: what it says, what is rewarded, and what a memory is worth."""

import pickle
from typing import Any

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test

from sb3_belief.envs import SUITES, Suite, make_parallel_env
from sb3_belief.envs.adapters import mpe
from sb3_belief.envs.foreign_speaker import ForeignSpeaker
from sb3_belief.envs.foreign_speaker.policies import BlindListener, KnowingListener, RememberingListener
from sb3_belief.envs.reference_policies import reference_returns
from sb3_belief.team import make_team_env
from sb3_belief.team.lockstep.joint_loop import JointLoop

ME = "listener_0"


def play(env, n_steps, seed=0):
    """Play at random, and return all that was seen and told."""
    generator = np.random.default_rng(seed)
    seen: list[Any] = []
    for _ in range(n_steps):
        if not env.agents:
            seen.append(env.reset()[0][ME].tolist())
        obs, rewards, ends, _, infos = env.step({ME: int(generator.integers(5))})
        seen.append((obs[ME].tolist(), rewards[ME], ends[ME], infos["partner"], env.scripted_actions()))
    return seen


def languages(n_episodes, seed=3, **kwargs):
    """Return who speaks in each episode."""
    env = ForeignSpeaker(**kwargs)
    met = []
    for episode in range(n_episodes):
        env.reset(seed=seed if episode == 0 else None)
        met.append(env.partner)
    return met


def test_it_is_mpes_game_with_a_scripted_speaker_and_a_reward_at_the_end():
    env, other = ForeignSpeaker(), mpe.make("simple_speaker_listener_v4")
    obs, obs2 = env.reset(seed=4)[0], other.reset(seed=4)[0]
    assert env.observation_space(ME) == other.observation_space(ME)
    generator = np.random.default_rng(0)
    for t in range(25):
        np.testing.assert_array_equal(obs[ME], obs2[ME])
        symbol = int(env.partner.split("-")[env.goal])
        action = int(generator.integers(5))
        obs, rewards, terminations, truncations, infos = env.step({ME: action})
        obs2, rewards2, *_ = other.step({"speaker_0": symbol, ME: action})
        assert env.scripted_actions() == {"speaker_0": symbol} and infos == {ME: {}, "partner": env.partner}
        assert obs[ME][8:].tolist() == np.eye(3)[symbol].tolist()
        distance = np.square(obs[ME][2:8].reshape(3, 2)[env.goal]).sum()
        assert rewards[ME] == (25 * rewards2[ME] if t == 24 else 0)
        assert t < 24 or rewards[ME] == pytest.approx(-25 * distance, rel=1e-5)
        assert (terminations[ME], truncations[ME], env.agents) == (t == 24, False, [ME] if t < 24 else [])


def test_a_language_stays_for_eight_episodes_and_is_one_of_six():
    met = languages(320)
    blocks = np.array(met).reshape(40, 8)
    assert (blocks == blocks[:, :1]).all() and len(set(met)) == 6
    assert met[:16] == languages(16) and met[:16:8] != languages(16, seed=4)[::8]
    assert languages(24, partner_seed=1)[::8] != met[:24:8]
    assert len(set(languages(60, redraw_every=None))) == 1
    # Rollouts of two episodes and a half: whoever comes in the middle of an episode is met in the next one
    env = ForeignSpeaker(redraw_every=1, redraw_unit="rollouts", per_copy=False, rollout_steps=60)
    env.reset(seed=0)
    told = [entry[3] for entry in play(env, 300) if isinstance(entry, tuple)]
    assert len(set(told[:75])) == 1 and told[25 * 3 - 1] == told[0]
    single, other = ForeignSpeaker(redraw_every=1), languages(10, redraw_every=1)
    single.reset(seed=3)
    assert [single.partner, *(entry[3] for entry in play(single, 250) if isinstance(entry, tuple))][1::25] == other


def test_only_the_oracle_is_told_the_language():
    def seen(**kwargs):
        env = make_team_env("foreign-speaker", 2, seed=0, env_kwargs=kwargs)
        loop, obs, told, met = JointLoop(env), env.reset()[ME], [], []
        with pytest.raises(AttributeError, match="not 'partner'"):
            loop.agent_envs[ME].get_attr("partner")
        for _ in range(30):
            actions = {ME: np.array([1, 4])}
            step = env.step(actions)
            ((obs, _, _, infos),) = loop._splitter.split(actions, step)
            assert not any("partner" in info for info in infos)
            met.append([info["partner"] for info in step[3]])
            # All but what was heard
            told.append(np.delete(obs, [8, 9, 10], axis=1))
        assert met[-1] == env.get_attr("partner")
        env.close()
        return np.array(told), met

    (obs, met), (obs2, met2) = seen(), seen(partner_seed=1)
    assert met[0] != met2[0]
    np.testing.assert_array_equal(obs, obs2)
    told, met3 = seen(reveal_partner=True)
    np.testing.assert_array_equal(told[:, :, :8], obs)
    names = sorted(["0-1-2", "0-2-1", "1-0-2", "1-2-0", "2-0-1", "2-1-0"])
    assert met3 == met and told[0, :, 8:].tolist() == [np.eye(6)[names.index(name)].tolist() for name in met[0]]


@pytest.mark.parametrize("at", [0, 7, 25, 60])
def test_state_resumes_exactly(at):
    env, other = ForeignSpeaker(redraw_every=2), ForeignSpeaker(redraw_every=2)
    env.reset(seed=1)
    play(env, at)
    state = pickle.loads(pickle.dumps(env.get_state()))
    expected = play(env, 120, seed=5)
    other.reset(seed=9)
    play(other, 3)
    other.set_state(state)
    assert play(other, 120, seed=5) == expected


@pytest.mark.filterwarnings("ignore:Agent was given info but was dead")
def test_pettingzoo_api():
    parallel_api_test(ForeignSpeaker(reveal_partner=True), num_cycles=60)


def test_what_a_memory_is_worth():
    n_envs = 12
    env = make_team_env(ForeignSpeaker, n_envs)
    knows = reference_returns(KnowingListener(n_envs), env, 2)
    assert abs(knows.mean() + 0.02) < 0.01
    remembers = reference_returns(RememberingListener(n_envs), env, 24).reshape(n_envs * 3, 8)
    # The last meaning is clear as soon as two have been seen
    assert remembers[:, 0].mean() < -7 and remembers[:, 5:].mean() > -1 and -3.5 < remembers.mean() < -1.5
    blind = reference_returns(BlindListener(n_envs), env, 8)
    assert abs(blind.mean() + 11.1) < 4 * blind.std() / np.sqrt(blind.size) < 5
    env.close()


@pytest.mark.parametrize(
    "kwargs, says",
    [
        ({"redraw_every": 0}, "redraw_every=0"),
        ({"redraw_unit": "rollouts"}, "rollout_steps=None must be an integer >= 1, the learner's n_steps"),
        ({"rollout_steps": 0}, "rollout_steps=0"),
        ({"per_copy": False}, "needs per_copy=True"),
        ({"reveal_partner": "yes"}, "reveal_partner='yes' must be"),
        ({"render_mode": "ansi"}, "render_mode='ansi'"),
    ],
)
def test_arguments_that_are_refused(kwargs, says):
    with pytest.raises(ValueError, match=says):
        ForeignSpeaker(**kwargs)


def test_wrong_actions_are_refused():
    env = ForeignSpeaker()
    with pytest.raises(ValueError, match="call reset"):
        env.step({ME: 0})
    env.reset()
    wrong: list[Any] = [{}, {ME: 5}]
    for actions in wrong:
        with pytest.raises(ValueError, match="allowed are the integers 0 to 4"):
            env.step(actions)


def test_without_mpe2_the_line_that_installs_it_is_told(monkeypatch):
    monkeypatch.setattr(Suite, "missing", lambda suite: list(suite.modules))
    with pytest.raises(ModuleNotFoundError, match="'foreign-speaker' needs 'mpe2', which is not installed: pip install mpe2"):
        make_parallel_env("foreign-speaker")
    with pytest.raises(ModuleNotFoundError, match=SUITES["mpe"].install):
        ForeignSpeaker()


def test_a_picture():
    env = ForeignSpeaker(render_mode="rgb_array")
    env.reset(seed=0)
    assert env.render().shape == (700, 700, 3) and env.picture_positions().keys() == {ME}
    with pytest.raises(ValueError, match="without a render mode"):
        ForeignSpeaker().render()
