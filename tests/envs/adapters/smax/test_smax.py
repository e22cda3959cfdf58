"""SMAX in batches and one by one. The tests need jaxmarl in an environment of its own (``make test-smax``)."""

import pickle
import subprocess
import sys
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest
from sb3_contrib.common.maskable import evaluation as masked_evaluation
from stable_baselines3.common import evaluation

from sb3_belief import BeliefPPO, MaskableBeliefPPO, team
from sb3_belief.envs.adapters.smax.vec_env import SmaxVecEnv
from tests.envs.adapters.smax.helpers import (
    OWN_FEATURES,
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

# Typed as Any, since the tests also look at attributes that the public types do not have
make_team_env: Any = team.make_team_env
Team: Any = team.Team


def test_the_package_is_imported_silently_and_only_when_needed():
    code = (
        "import sys; before = sys.stdout, sys.stderr, sys.__stdout__\n"
        "from sb3_belief.envs.adapters.smax import names\n"
        "assert 'jax' not in sys.modules\n"
        "assert '3m' in names() and '6h_vs_8z' in names() and 'corridor' not in names()\n"
        "assert before == (sys.stdout, sys.stderr, sys.__stdout__)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == ""
    assert "ubmodule" not in done.stderr


def test_a_batch_equals_single_copies_under_the_general_vectoriser(mixed):
    single = make("2s3z")
    mixed.seed(7)
    general = make_team_env(partial(make, "2s3z"), n_envs=4, seed=7)
    assert isinstance(make_team_env("smax/2s3z", n_envs=4), SmaxVecEnv) and not isinstance(general, SmaxVecEnv)
    assert mixed.observation_space == general.observation_space and mixed.action_space == general.action_space
    assert mixed.observation_space["ally_0"].shape == (9 * UNIT_FEATURES + OWN_FEATURES,)
    first, second = mixed.reset(), general.reset()
    generator = np.random.default_rng(0)
    ends = died = 0
    for _ in range(150):
        masks, other_masks = mixed.action_masks(), general.action_masks()
        for agent in single.possible_agents:
            assert first[agent].tobytes() == second[agent].tobytes()
            assert first[agent].dtype == np.float32 and first[agent].flags.writeable
            np.testing.assert_array_equal(masks[agent], other_masks[agent])
        actions = masked_choice(masks, generator)
        first, rewards, dones, infos = mixed.step(actions)
        second, other_rewards, other_dones, other_infos = general.step(actions)
        assert rewards.dtype == np.float32 and rewards.tobytes() == other_rewards.tobytes()
        np.testing.assert_array_equal(dones, other_dones)
        ends += dones.sum()
        for info, other in zip(infos, other_infos, strict=True):
            assert info.keys() == other.keys()
            for key in ("agent_rewards", "visible", "active", "life_end", "truncated"):
                assert info[key].dtype == other[key].dtype
                np.testing.assert_array_equal(info[key], other[key], err_msg=key)
            # Who has just died, as the agents are told
            assert info.get("agent_infos") == other.get("agent_infos")
            died += len(info.get("agent_infos", {}))
            for key in ("is_success", "TimeLimit.truncated"):
                assert info.get(key) is other.get(key)
            assert info.get("episode", {}).get("r") == other.get("episode", {}).get("r")
            for agent, values in info.get("terminal_observation", {}).items():
                assert values.tobytes() == other["terminal_observation"][agent].tobytes()
    assert ends >= 8 and died > 20


def test_a_copy_depends_on_its_own_seed_alone(mixed):
    def lives(seeds, idle):
        for copy, seed in enumerate(seeds):
            mixed._seeds[copy] = seed
        rows = [mixed.reset()["ally_1"][0]]
        generator = np.random.default_rng(3)
        for _ in range(60):
            actions = masked_choice({agent: mask[:1] for agent, mask in mixed.action_masks().items()}, generator)
            others = np.full(3, STOP) if idle else np.zeros(3, dtype=int)
            obs = mixed.step({agent: np.concatenate([action, others]) for agent, action in actions.items()})[0]
            rows.append(obs["ally_1"][0])
        return np.array(rows)

    life = lives([2**32 - 1, 1, 2, 3], idle=True)
    np.testing.assert_array_equal(life, lives([2**32 - 1, 5, 6, 7], idle=False))
    assert not np.array_equal(life, lives([2**31 - 1, 1, 2, 3], idle=True))
    mixed.seed(0)
    obs = mixed.reset()["ally_0"]
    assert len(np.unique(obs, axis=0)) == 4, "copies differ"
    assert not np.array_equal(obs, mixed.reset()["ally_0"]), "a seed is used once"


def test_state_resumes_exactly(mixed):
    def play(env, draws):
        rows = []
        for draw in draws:
            obs, rewards, dones, infos = env.step(dict(zip(env.possible_agents, draw, strict=True)))
            untimed = [{**info, "episode": info.get("episode", {}).get("r")} for info in infos]
            rows.append((dict(obs), rewards, dones, untimed, env.action_masks()))
        return pickle.dumps(rows)

    mixed.seed(5)
    mixed.reset()
    generator = np.random.default_rng(5)
    play(mixed, generator.integers(0, 10, size=(30, 5, 4)))
    states = pickle.loads(pickle.dumps(mixed.get_state()))
    obs = {agent: values.copy() for agent, values in zip(mixed.possible_agents, mixed.battles.observations, strict=True)}
    draws = generator.integers(0, 10, size=(60, 5, 4))
    mixed._zero_episode_sums()
    expected = play(mixed, draws)
    other = make_batched("2s3z", 4)
    other.reset()
    for agent, values in other.set_state(states).items():
        np.testing.assert_array_equal(values, obs[agent])
    assert play(other, draws) == expected
    with pytest.raises(ValueError, match="2 copies for 4"):
        other.set_state(states[:2])
    with pytest.raises(ValueError, match=r"smax/2s3z for smax/3m"):
        make("3m", **PEACE).set_state({"battle": states[0], "visible": np.zeros((5, 4)), "under_way": True})


def test_a_single_environment_can_be_copied():
    env = make("3m", **PEACE)
    env.reset(seed=3)
    env.step(attack(env))
    other = pickle.loads(pickle.dumps(env))
    for _ in range(5):
        actions = attack(env)
        first, second = env.step(actions), other.step(actions)
        for agent in env.agents:
            np.testing.assert_array_equal(first[0][agent], second[0][agent])
    # An environment can be copied before its first reset too
    pickle.loads(pickle.dumps(make("3m", **PEACE))).reset(seed=0)


def test_pictures():
    env = make("3m", render_mode="rgb_array", **PEACE)
    env.reset(seed=0)
    picture = env.render()
    assert picture.dtype == np.uint8 and picture.shape == (400, 400, 3)
    # Allies are blue and on the left, enemies red and on the right
    red, blue = picture[..., 0].astype(int), picture[..., 2].astype(int)
    assert (blue[:, :200] - red[:, :200] > 50).any() and (red[:, 200:] - blue[:, 200:] > 50).any()
    assert not (blue[:, 200:] - red[:, 200:] > 50).any()


def test_before_the_first_reset_the_units_can_only_stop():
    env = make_batched("3m", 2, **PEACE)
    for masks in env.action_masks().values():
        assert masks.tolist() == [[k == STOP for k in range(8)]] * 2
    with pytest.raises(ValueError, match="before the first reset"):
        env.get_state()


def test_wrong_use(mixed):
    with pytest.raises(ValueError, match="'corridor'; there are 3m"):
        make("corridor")
    with pytest.raises(ValueError, match=r"'action_type'.*'max_steps'"):
        make_batched("3m", 2, action_type="continuous")
    with pytest.raises(ValueError, match="attack_mode='weakest'"):
        make("3m", attack_mode="weakest")
    with pytest.raises(ValueError, match="render_mode='human'"):
        make("3m", render_mode="human", **PEACE)
    with pytest.raises(ValueError, match="num_envs=0"):
        make_batched("3m", 0)
    mixed.reset()
    stay = {agent: np.full(4, STOP) for agent in mixed.possible_agents}
    with pytest.raises(ValueError, match="'ally_3' in copy 2 is 10; allowed are the integers from 0 to 9"):
        mixed.step({**stay, "ally_3": np.array([0, 1, 10, 2])})
    with pytest.raises(ValueError, match="type float64"):
        mixed.step({agent: values / 1.0 for agent, values in stay.items()})
    single = make("3m", **PEACE)
    with pytest.raises(ValueError, match=r"reset\(\)"):
        single.step(dict.fromkeys(single.possible_agents, STOP))
    single.reset()
    with pytest.raises(ValueError, match="No action for 'ally_2'"):
        single.step({"ally_0": 0, "ally_1": 0})
    with pytest.raises(ValueError, match="'ally_1' is -1"):
        single.step({"ally_0": 0, "ally_1": -1, "ally_2": 0})
    with pytest.raises(ValueError, match="without a render mode"):
        single.render()


@pytest.mark.parametrize("algorithm", [BeliefPPO, MaskableBeliefPPO])
def test_a_team_learns_is_saved_and_evaluated(tmp_path, algorithm):
    kwargs: dict[str, Any] = dict(n_steps=32, batch_size=64, n_epochs=2, history_length=100, keep_ratio=0.5)
    env = make_team_env("smax/2s3z", n_envs=4, seed=0)
    learners = Team(algorithm, "BeliefPolicy", env, seed=0, **kwargs).learn(2 * 32 * 4)
    for model in learners.agents.values():
        buffer = model.rollout_buffer
        assert buffer.others_visible.any() and not buffer.others_visible[~buffer.active].any()
        labels = buffer.others_actions.reshape(*buffer.others_visible.shape, 10).sum(axis=-1)
        np.testing.assert_array_equal(labels, buffer.others_visible.astype(np.float32))
    learners.save(tmp_path / "team")
    loaded = Team.load(tmp_path / "team.zip", env=env)
    obs = env.reset()
    masks = env.action_masks() if algorithm is MaskableBeliefPPO else None
    extra = {} if masks is None else {"action_masks": masks}
    for agent, actions in loaded.predict(obs, deterministic=True, **extra)[0].items():
        np.testing.assert_array_equal(actions, learners.predict(obs, deterministic=True, **extra)[0][agent])
    evaluate: Any = masked_evaluation if algorithm is MaskableBeliefPPO else evaluation
    rewards, lengths = evaluate.evaluate_policy(loaded, env, 4, return_episode_rewards=True)
    assert len(rewards) == 4 and max(lengths) <= 101


def test_time_limits_are_bootstrapped_and_ends_are_not(mixed):
    """The advantages of a stored rollout equal those computed here by their definition."""
    import torch as th
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback

    class Keep(BaseCallback):
        """Callback that keeps rewards, dones and infos of all steps."""

        def __init__(self):
            super().__init__()
            self.rows: list[tuple] = []

        def _on_step(self):
            # Copied now, since SB3 adds the bootstrapped values to the rewards in place
            self.rows.append((self.locals["rewards"].copy(), self.locals["dones"].copy(), self.locals["infos"]))
            return True

    mixed.seed(3)
    mixed.reset()
    # Two copies start near their step limit, the other two play on
    states = mixed.get_state()
    for state in states[:2]:
        set_step(state, 90)
    learner = Team(PPO, "MlpPolicy", mixed, seed=0, n_steps=60, batch_size=60, n_epochs=1, learning_rate=0.0, gamma=0.9)
    reset = mixed._reset_joint
    mixed._reset_joint = lambda: (reset(), mixed.set_state(states))[1]
    keep = Keep()
    try:
        learner.learn(240, agent_callbacks={"ally_0": keep})
    finally:
        mixed._reset_joint = reset
    model = learner.agents["ally_0"]
    buffer, policy = model.rollout_buffer, model.policy

    def value(obs):
        with th.no_grad():
            return float(policy.predict_values(policy.obs_to_tensor(obs)[0]))

    # After the update the rows of a copy stand one after the other
    values, advantages = buffer.values.reshape(4, 60), buffer.advantages.reshape(4, 60)
    cuts = ends = 0
    for copy in range(4):
        following, advantage = value(model._last_obs[copy]), 0.0
        for step in reversed(range(60)):
            rewards, dones, infos = keep.rows[step]
            if dones[copy]:
                advantage = 0.0
                cut = infos[copy]["TimeLimit.truncated"]
                following = value(infos[copy]["terminal_observation"]) if cut else 0.0
                cuts, ends = cuts + cut, ends + (not cut)
            advantage = rewards[copy] + 0.9 * following - values[copy, step] + 0.9 * 0.95 * advantage
            np.testing.assert_allclose(advantages[copy, step], advantage, atol=1e-4)
            following = values[copy, step]
    assert cuts == 2 and ends > 0


@pytest.mark.slow
def test_workers():
    env = make_team_env("smax/3m", n_envs=1, seed=0, vec_env="subproc", env_kwargs=PEACE)
    try:
        single = make("3m", **PEACE)
        expected = single.reset(seed=0)[0]
        for agent, values in env.reset().items():
            np.testing.assert_array_equal(values[0], expected[agent])
    finally:
        env.close()


def test_states_and_last_masks_of_a_batch_equal_those_of_single_copies():
    mixed, general = make_batched("3m", 2), make_team_env(partial(make, "3m"), n_envs=2)
    for env in (mixed, general):
        env.seed(7)
        env.reset()
    assert mixed.state_source == general.state_source == "env" and mixed.state_space == general.state_space
    generator, ended = np.random.default_rng(0), 0
    for _ in range(80):
        assert mixed.states().shape == (2, mixed.state_space.shape[0])
        np.testing.assert_allclose(mixed.states(), general.states(), atol=1e-5)
        actions = masked_choice(mixed.action_masks(), generator)
        (_, _, dones, infos), (_, _, _, others) = mixed.step(actions), general.step(actions)
        for copy in np.flatnonzero(dones):
            ended += 1
            last, same = infos[copy], others[copy]
            np.testing.assert_allclose(last["terminal_state"], same["terminal_state"], atol=1e-5)
            for agent, mask in last["terminal_action_masks"].items():
                assert mask.tolist() == same["terminal_action_masks"][agent].tolist()
    assert ended
