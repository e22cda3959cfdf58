import numpy as np
import pytest
import torch as th
from sb3_contrib import MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO

from sb3_belief import BeliefPPO, MaskableBeliefPPO
from sb3_belief.common.action_encoding import action_encoding
from sb3_belief.report.frames import NoPictureError
from sb3_belief.zoo.evaluate import evaluate
from tests.report.recorded import LIMIT, SCRIPTED, SPACES, recorded, trained


@pytest.fixture(scope="module")
def team_and_env():
    return trained(normalize=True)


@pytest.fixture(scope="module")
def recording(team_and_env):
    return recorded(*team_and_env, episodes=2)


def moments(recording):
    return [moment for episode in recording.episodes for moment in episode.moments]


def copied(team):
    return {
        agent: {name: value.clone() for name, value in model.policy.state_dict().items()}
        for agent, model in team.agents.items()
    }


@pytest.mark.parametrize("deterministic", [True, False])
def test_a_recording_is_the_very_episode(team_and_env, deterministic):
    team, env = team_and_env
    before = copied(team)
    th.manual_seed(3)
    np.random.seed(3)
    recording = recorded(team, env, episodes=3, deterministic=deterministic)
    th.manual_seed(3)
    np.random.seed(3)
    env.seed(5)
    outcome = evaluate(team, env, 3, deterministic)
    assert [episode.team_return for episode in recording.episodes] == outcome.returns.tolist()
    assert [episode.success for episode in recording.episodes] == outcome.successes.tolist()
    assert [sum(moment.reward for moment in episode.moments) for episode in recording.episodes] == pytest.approx(
        outcome.returns.tolist()
    )
    # The history stays what it was, as in an evaluation
    for agent, values in copied(team).items():
        assert all(th.equal(value, before[agent][name]) for name, value in values.items())


def test_predictions_are_those_of_predict_others_on_the_observations(team_and_env, recording):
    team, env = team_and_env
    env.seed(5)
    obs, seen = env.reset(), 0
    for moment in moments(recording):
        for agent, model in team.agents.items():
            observed = team.observed_by(agent, obs[agent])
            assert not np.allclose(observed, obs[agent])
            expected = model.policy.predict_others(observed)
            found = moment.agents[agent]
            np.testing.assert_array_equal(found.observation, observed)
            assert (
                list(found.prediction.actions) == recording.others_of(agent) == [*(n for n in SPACES if n != agent), "clock"]
            )
            for other in expected.actions:
                np.testing.assert_array_equal(found.prediction.actions[other], expected.actions[other][0])
            np.testing.assert_array_equal(found.prediction.rows, expected.rows[0])
            np.testing.assert_array_equal(found.prediction.weights, expected.weights[0])
            assert found.prediction.weights.sum() == pytest.approx(1.0, abs=1e-5) and len(found.prediction.rows) > 0
            seen += 1
        actions, _ = team.predict(obs, deterministic=True)
        obs, rewards, _, infos = env.step(actions)
        assert moment.reward == rewards[0]
        for i, agent in enumerate(SPACES):
            np.testing.assert_array_equal(moment.actions[agent], actions[agent].reshape(-1))
            np.testing.assert_array_equal(moment.agents[agent].visible, infos[0]["visible"][i])
            assert moment.agents[agent].reward == infos[0]["agent_rewards"][i]
    assert seen == 2 * LIMIT * len(SPACES)


def test_scripted_others_and_steps_out_of_play(recording):
    assert recording.action_spaces["clock"] == SCRIPTED
    steps = moments(recording)[:LIMIT]
    assert [moment.actions["clock"].tolist() for moment in steps] == [[0], [1]] * 3
    assert [moment.agents["discrete"].active for moment in steps] == [True, True, False, False, True, True]
    assert all(moment.agents["numbers"].active for moment in steps)
    # Pictures change at every second step only
    assert [moment.frame for moment in steps] == [0, 0, 1, 1, 2, 2] and len(recording.frames) == 3
    assert steps[0].positions == {"discrete": (0.25, 0.5), "clock": (0.75, 0.5)}


def test_names_of_actions_are_taken_where_they_fit(recording):
    assert recording.action_names == {"discrete": [["stay", "<b>left</b>", "right"]]}


def test_own_probabilities_are_those_of_the_policy(team_and_env, recording):
    team, _ = team_and_env
    for moment in moments(recording):
        for agent, model in team.agents.items():
            own = moment.agents[agent]
            tensor = model.policy.obs_to_tensor(own.observation)[0]
            with th.no_grad():
                distribution = model.policy.get_distribution(tensor)
                assert own.choice.value == pytest.approx(float(model.policy.predict_values(tensor)))
            done = moment.actions[agent]
            if agent == "numbers":
                assert own.choice.kind == "mean"
                np.testing.assert_allclose(own.choice.numbers, done, atol=1e-6)
                continue
            assert own.choice.kind == "probabilities"
            encoding = action_encoding(agent, SPACES[agent])
            parts = np.split(own.choice.numbers, np.cumsum(encoding.widths)[:-1])
            if encoding.kind == "binary":
                likelihood = np.prod(np.where(done > 0, parts[0], 1 - parts[0]))
            else:
                assert all(part.sum() == pytest.approx(1.0) for part in parts)
                likelihood = np.prod([part[int(index)] for part, index in zip(parts, done, strict=True)])
            exact = distribution.log_prob(th.as_tensor(done if agent == "discrete" else done[None])).exp()
            assert likelihood == pytest.approx(float(exact), rel=1e-4)


def test_teams_of_other_algorithms_are_recorded():
    plain = dict(n_steps=16, policy_kwargs={"net_arch": [8]})
    team, env = trained(
        {"discrete": DQN, "several": RecurrentPPO, "switches": A2C, "numbers": BeliefPPO},
        {"discrete": "MlpPolicy", "several": "MlpLstmPolicy", "switches": "MlpPolicy", "numbers": "BeliefPolicy"},
        agent_kwargs={
            "discrete": {"learning_starts": 4, "policy_kwargs": {"net_arch": [8]}},
            "several": {**plain, "batch_size": 16},
            "switches": plain,
            "numbers": {"n_steps": 16, "batch_size": 16, "n_epochs": 1},
        },
        shared={},
    )
    recording = recorded(team, env, episodes=2)
    env.seed(5)
    assert [episode.team_return for episode in recording.episodes] == evaluate(team, env, 2).returns.tolist()
    for moment in moments(recording):
        dqn, recurrent, a2c, belief = (moment.agents[agent] for agent in SPACES)
        assert dqn.choice.kind == "values" and dqn.choice.numbers.argmax() == moment.actions["discrete"][0]
        assert dqn.choice.value == pytest.approx(dqn.choice.numbers.max())
        # Its state goes on from step to step, or the most likely action would not be what it did
        parts = np.split(recurrent.choice.numbers, [2])
        assert [part.argmax() for part in parts] == moment.actions["several"].tolist() and recurrent.choice.value is None
        assert ((a2c.choice.numbers > 0.5) == moment.actions["switches"]).all() and a2c.prediction is None
        assert belief.prediction is not None and belief.features is not None and a2c.features is None


@pytest.mark.parametrize(("maskable", "policy"), [(MaskablePPO, "MlpPolicy"), (MaskableBeliefPPO, "BeliefPolicy")])
def test_masked_actions_have_no_probability(maskable, policy):
    team, env = trained(
        {"discrete": maskable, "several": PPO, "switches": PPO, "numbers": PPO},
        {"discrete": policy, "several": "MlpPolicy", "switches": "MlpPolicy", "numbers": "MlpPolicy"},
        env_kwargs={"masked": True},
        shared={"n_steps": 16, "batch_size": 16, "policy_kwargs": {"net_arch": [8]}},
    )
    recording = recorded(team, env)
    for t, moment in enumerate(moments(recording)):
        numbers = moment.agents["discrete"].choice.numbers
        allowed = np.array([True, False, t % 2 == 0])
        assert (numbers[~allowed] < 1e-6).all() and numbers.sum() == pytest.approx(1.0)
        assert allowed[moment.actions["discrete"][0]]
    env.seed(5)
    assert recording.episodes[0].team_return == evaluate(team, env, 1).returns[0]


def test_a_recording_ends_after_so_many_steps(team_and_env):
    recording = recorded(*team_and_env, episodes=3, most_steps=LIMIT + 2)
    assert [(len(episode.moments), episode.finished) for episode in recording.episodes] == [(LIMIT, True), (2, False)]
    assert recorded(*team_and_env, episodes=3, most_steps=LIMIT).episodes[-1].finished


def test_an_environment_without_a_picture_is_refused():
    team, env = trained(PPO, "MlpPolicy", env_kwargs={"picture": False}, shared={"n_steps": 16, "batch_size": 16})
    with pytest.raises(NoPictureError, match=r"an array of shape \(\), not an image"):
        recorded(team, env)
