"""Learning of a factorised value: targets, masks, exploration, memory, files."""
# mypy: disable-error-code="arg-type, operator"

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize

from sb3_belief.references.factorisation import ValueFactorisation
from sb3_belief.references.factorised_policy import MIXERS
from sb3_belief.references.joint_vec_env import JointVecEnv, joint_team
from sb3_belief.team import Team, make_team_env
from tests.references.counting_team import CountingTeam, UnequalTeam, joint_env, recorded_logs


def learner(env=None, **kwargs):
    policy_kwargs = {"hidden_dim": 8, **kwargs.pop("policy_kwargs", {})}
    arguments = {"batch_size": 2, "buffer_size": 20, "seed": 0, "policy_kwargs": policy_kwargs, **kwargs}
    return ValueFactorisation("FactorisedPolicy", joint_env(n_envs=2) if env is None else env, **arguments)


def weights(model):
    return th.cat([parameter.detach().flatten() for parameter in model.policy.net.parameters()])


@pytest.mark.parametrize("mixer", MIXERS)
@pytest.mark.parametrize("policy_kwargs", [{}, {"recurrent": False, "share": False}], ids=["shared GRU", "own MLP"])
def test_learns_acts_and_is_saved(mixer, policy_kwargs, tmp_path):
    model = learner(mixer=mixer, td_lambda=0.5, policy_kwargs=policy_kwargs)
    before = weights(model)
    model.learn(40)
    assert not th.equal(weights(model), before) and weights(model).isfinite().all()
    # Of 2 copies with 3 steps each, 6 episodes of each have ended, and one for each copy begins an update
    assert model._n_updates == 6
    model.save(tmp_path / "model")
    # The user's own arguments are compared with those that are saved
    own = {"hidden_dim": 8, **policy_kwargs}
    loaded = ValueFactorisation.load(tmp_path / "model", env=joint_env(n_envs=2), policy_kwargs=own)
    assert th.equal(weights(loaded), weights(model)) and loaded.exploration_rate == model.exploration_rate
    returns = [evaluate_policy(each, joint_env(n_envs=2), 4) for each in (model, loaded)]
    assert returns[0] == returns[1]
    loaded.learn(40, reset_num_timesteps=False)
    assert loaded.num_timesteps == 80 and not th.equal(weights(loaded), weights(model))


@pytest.mark.parametrize("mixer", MIXERS)
def test_equal_seeds_learn_the_same(mixer):
    first, second = (learner(mixer=mixer).learn(30) for _ in range(2))
    assert th.equal(weights(first), weights(second))


def batch_of(model, n_episodes=2):
    """Play, and return episodes."""
    model.learn(6 * n_episodes)
    return model.replay_buffer.batch(model.replay_buffer.episodes[:n_episodes])


@pytest.mark.parametrize("mixer", MIXERS)
@pytest.mark.parametrize("td_lambda", [0.0, 0.8])
def test_only_the_right_targets_move(mixer, td_lambda):
    model = learner(mixer=mixer, td_lambda=td_lambda)
    batch = batch_of(model)
    at = model.targets(batch)

    def moved(**changes):
        return (model.targets(batch._replace(**changes)) - at).abs().gt(1e-6).tolist()

    # Through lambda a target feels what follows in its own episode, and nothing else
    before = td_lambda > 0
    rewards = batch.rewards.clone()
    rewards[0, 1] += 1
    assert moved(rewards=rewards) == [[before, True, False], [False] * 3]
    ends = batch.ends.clone()
    ends[1, 2] = 0
    assert moved(ends=ends) == [[False] * 3, [before, before, True]]
    # What follows an action is valued by the state after it
    state = batch.state.clone()
    state[0, 2] += 1
    uses = mixer != "vdn"
    assert moved(state=state) == [[uses and before, uses, False], [False] * 3]


@pytest.mark.parametrize("mixer", MIXERS)
def test_a_limit_bootstraps_and_an_end_does_not(mixer):
    for truncates in (False, True):
        model = learner(joint_env(n_envs=2, truncates=truncates), mixer=mixer, policy_kwargs={"recurrent": False})
        batch = batch_of(model)
        at = model.targets(batch)[:, -1]
        if not truncates:
            assert th.equal(at, batch.rewards[:, -1])
        else:
            last = slice(-1, None)
            best = model.policy.net(batch).rows(last).greedy()
            value = model.policy.target_net.mixer.joint_value(model.policy.target_net(batch).rows(last), best)[:, 0]
            assert th.allclose(at, batch.rewards[:, -1] + 0.99 * value) and not th.equal(at, batch.rewards[:, -1])


@pytest.mark.parametrize("mixer", MIXERS)
def test_values_of_illegal_actions_count_for_nothing(mixer):
    model = learner(joint_env(n_envs=2, truncates=True), mixer=mixer)
    batch = batch_of(model)
    at, q = model.targets(batch), model.policy.net(batch).q
    assert q[~batch.mask].isinf().all() and q[batch.mask].isfinite().all()
    assert not batch.mask[:, :3, 1, 2].any() and batch.mask[:, 3, 1, 2].all(), "legal in the last observation alone"
    # The value of this action is raised everywhere, and it becomes the best one where it is legal
    for net in (model.policy.net, model.policy.target_net):
        net.agents.nets[0].last.bias.data[2] += 100
    moved = (model.targets(batch) - at).abs() > 1e-3
    assert not moved[:, :-1].any() and (moved[:, -1].all() or mixer == "qtran")
    assert model.policy.net(batch).rows(slice(3, None)).greedy()[:, 1].eq(2).all()


def test_double_q():
    model = learner(mixer="vdn", policy_kwargs={"recurrent": False})
    batch = batch_of(model)
    # The present network prefers the action 0 of all agents, the target network the action 1, where it is legal
    model.policy.net.agents.nets[0].last.bias.data[:2] = th.tensor([9.0, -9.0])
    model.policy.target_net.agents.nets[0].last.bias.data[:2] = th.tensor([-9.0, 9.0])
    values = model.policy.target_net(batch).rows(slice(1, 3))
    expected = batch.rewards[:, :2] + 0.99 * values.q[..., 0].sum(-1).reshape(2, 2)
    assert th.allclose(model.targets(batch)[:, :2], expected)


def test_the_loss_is_the_mean_over_the_steps_that_exist():
    model = learner(mixer="qmix", learning_rate=0.0)
    model.learn(12)
    short = {key: value.copy() for key, value in model.replay_buffer.episodes[0].items()}
    for key, value in short.items():
        short[key] = value[:2] if key in ("obs", "mask", "state") else value[:1]
    long = model.replay_buffer.episodes[1]
    alone = [model._update(model.replay_buffer.batch([episode]))["loss"] for episode in (short, long)]
    together = model._update(model.replay_buffer.batch([short, long]))["loss"]
    assert together == pytest.approx((1 * alone[0] + 3 * alone[1]) / 4, rel=1e-5)


@pytest.mark.parametrize("mixer", MIXERS)
@pytest.mark.parametrize("kwargs", [{}, {"truncates": True}, {"nothing": True}], ids=["ends", "limits", "nothing is legal"])
def test_steps_that_do_not_exist_may_have_any_masks(mixer, kwargs):
    env = JointVecEnv(make_team_env(lambda: UnequalTeam(**kwargs), n_envs=2))
    model = learner(env, mixer=mixer, batch_size=4)
    losses = recorded_logs(model)
    model.learn(60)
    assert {len(episode["rewards"]) for episode in model.replay_buffer.episodes} == {3, 4, 5}
    assert losses and np.isfinite([list(each.values()) for each in losses]).all() and weights(model).isfinite().all()


def test_who_has_learned_nothing_says_so():
    with pytest.warns(UserWarning, match=r"has not learned anything: 0 episodes have ended in 40 steps, .* batch_size=2"):
        learner(joint_env(n_envs=2, length=10**6)).learn(40)


def test_actions_are_legal_and_coins_are_thrown_for_each_agent_and_copy():
    n_envs = 2000
    model = learner(joint_env(n_envs=2))
    obs = joint_env().reset()
    obs = {key: np.repeat(part, n_envs, axis=0) for key, part in obs.items()}
    best, _ = model.predict(obs, deterministic=True)
    assert (best == best[0]).all()
    legal = np.take_along_axis(obs["mask"], best[..., None], axis=-1)
    assert legal.all()
    model.exploration_rate = 1.0
    anything, _ = model.predict(obs)
    for agent in range(2):
        # "b" may not choose its third action here
        counts = np.bincount(anything[:, agent], minlength=3) / n_envs
        assert counts == pytest.approx([0.5, 0.5, 0], abs=0.05)
    model.exploration_rate = 0.5
    differs = model.predict(obs)[0] != best
    # Half of the random actions are the best ones
    assert differs.mean(axis=0) == pytest.approx([0.25, 0.25], abs=0.04)
    assert (differs[:, 0] & differs[:, 1]).mean() == pytest.approx(0.0625, abs=0.03)


def test_epsilon_falls_over_the_steps_of_all_copies():
    model = learner(exploration_steps=40, exploration_initial_eps=0.8, exploration_final_eps=0.2)
    assert model.exploration_rate == 0.8
    model.learn(20)
    assert model.exploration_rate == pytest.approx(0.5)
    model.learn(40, reset_num_timesteps=False)
    assert model.exploration_rate == pytest.approx(0.2)


def test_the_target_is_replaced_after_some_episodes():
    model = learner(target_update_interval=4)
    model.learn(6)
    online, target = (dict(net.named_parameters()) for net in (model.policy.net, model.policy.target_net))

    def equal():
        return all(th.equal(online[name], target[name]) for name in online)

    assert model._n_updates == 1 and not equal()
    model.learn(6, reset_num_timesteps=False)
    assert model._n_updates == 2 and equal()
    assert not any(parameter.requires_grad for parameter in target.values())


def test_several_updates_each_time():
    assert learner(gradient_steps=3).learn(12)._n_updates == 6


def test_the_state_of_predict_is_that_of_the_episode():
    model = learner()
    obs = joint_env(n_envs=2).reset()
    actions, state = model.predict(obs, deterministic=True)
    assert state[0].shape == (2, 2, 8) and state[1].shape == (2, 2, 3)
    assert state[1].argmax(-1).tolist() == actions.tolist()
    _, after = model.predict(obs, state, np.array([True, False]), deterministic=True)
    assert np.allclose(after[0][0], state[0][0]) and not np.allclose(after[0][1], state[0][1])
    single, _ = model.predict({key: part[0] for key, part in obs.items()}, deterministic=True)
    assert single.shape == (2,) and single.tolist() == actions[0].tolist()


def test_acting_in_training_remembers_the_episode_as_learning_does():
    model = learner(exploration_initial_eps=0.0, exploration_final_eps=0.0, learning_rate=0.0)
    model.learn(12)
    batch = model.replay_buffer.batch(model.replay_buffer.episodes)
    greedy = model.policy.net(batch).rows(slice(None, -1)).greedy()
    assert th.equal(greedy, batch.actions.flatten(0, 1))


class StopAfter(BaseCallback):
    """Stops the training at a step."""

    def _on_step(self):
        return self.n_calls < 4


def test_what_a_callback_broke_off_is_no_episode():
    model = learner()
    model.learn(100, callback=StopAfter())
    assert model.replay_buffer.size() == 2
    model.learn(12, reset_num_timesteps=False)
    assert all(len(episode["rewards"]) == 3 for episode in model.replay_buffer.episodes)
    assert all(episode["state"][:, 0].tolist() == [0, 1, 2, 3] for episode in model.replay_buffer.episodes)


def test_the_replay_is_saved_apart(tmp_path):
    model = learner().learn(12)
    model.save_replay_buffer(tmp_path / "replay")
    other = learner()
    other.load_replay_buffer(tmp_path / "replay")
    assert other.replay_buffer.size() == 4
    assert np.array_equal(other.replay_buffer.episodes[3]["obs"], model.replay_buffer.episodes[3]["obs"])


def test_dead_agents_take_part():
    model = learner(joint_env(n_envs=2, dies=1), mixer="qmix").learn(30)
    assert weights(model).isfinite().all()
    assert model.replay_buffer.episodes[0]["rewards"].shape == (3,), "their rows are kept"


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"mixer": "sum"}, "mixer='sum' must be one of 'vdn', 'qmix', 'qplex', 'qtran'"),
        ({"gamma": 1.5}, r"gamma=1.5 must be a number in \[0, 1\]"),
        ({"td_lambda": -1.0}, "td_lambda=-1.0"),
        ({"exploration_final_eps": 2}, "exploration_final_eps=2"),
        ({"batch_size": 0}, "batch_size=0"),
        ({"buffer_size": 1}, "buffer_size=1 must be an integer >= 2"),
        ({"gradient_steps": -1}, "gradient_steps=-1"),
        ({"target_update_interval": 0}, "target_update_interval=0"),
        ({"exploration_steps": 0}, "exploration_steps=0"),
    ],
)
def test_arguments_out_of_range(kwargs, message):
    with pytest.raises(ValueError, match=message):
        learner(**kwargs)


def test_environments_of_another_kind():
    with pytest.raises(ValueError, match="shown as one"):
        learner(make_team_env(CountingTeam, n_envs=1))
    env: VecNormalize = VecNormalize(joint_env(), norm_obs_keys=["obs"])
    with pytest.raises(ValueError, match="does not take normalised observations"):
        learner(env)


def test_as_the_one_learner_of_a_team(tmp_path):
    def env():
        return joint_team(make_team_env(CountingTeam, n_envs=2))

    team = Team(ValueFactorisation, "FactorisedPolicy", env(), seed=0, mixer="qmix", batch_size=2, buffer_size=20)
    team.learn(60)
    model = team.agents["team"]
    assert model._n_updates == 10 and model.num_timesteps == 60
    assert evaluate_policy(team, env(), 4)[0] >= 3
    team.save(tmp_path / "team")
    loaded = Team.load(tmp_path / "team", env=env())
    assert th.equal(weights(loaded.agents["team"]), weights(model))
    loaded.learn(60, reset_num_timesteps=False)
    assert loaded.num_timesteps == 120


@pytest.mark.parametrize("copies", [1, 3])
def test_a_saved_one_goes_on_in_another_number_of_copies(copies, tmp_path):
    learner().learn(20).save(tmp_path / "model")
    loaded = ValueFactorisation.load(tmp_path / "model", env=joint_env(n_envs=copies))
    assert loaded.learn(12 * copies, reset_num_timesteps=False).num_timesteps >= 20 + 12 * copies


def test_normalised_observations_are_refused_later_as_well():
    with pytest.raises(ValueError, match="does not take normalised observations"):
        learner().set_env(VecNormalize(joint_env(n_envs=2), norm_obs_keys=["obs"]))
