"""COMA: counterfactual advantages by hand, returns, ends, who was in play, files."""
# mypy: disable-error-code="arg-type, operator"

import io
import itertools

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_belief.references.coma import COMA
from sb3_belief.references.coma_policy import JointDistribution, coma_actor_loss, counterfactual_advantages, taken
from sb3_belief.references.joint_vec_env import joint_team
from tests.references.counting_team import CountingTeam, joint_env
from tests.team.exact.test_exact import SaveOnce
from tests.team.helpers import Team, make_team_env, parameters

PAYOFFS = th.tensor([[4.0, 0.0], [0.0, 2.0]])
JOINT = th.tensor(list(itertools.product(range(2), repeat=2)))


def exact_values(actions):
    """What an exact critic says of the payoffs: of the first agent's actions, and of the second one's."""
    return th.stack([PAYOFFS[:, actions[:, 1]].T, PAYOFFS[actions[:, 0]]], dim=1)


def learner(env=None, **kwargs):
    return COMA("ComaPolicy", joint_env(n_envs=2) if env is None else env, **{"n_steps": 6, "seed": 0, **kwargs})


def test_counterfactual_advantages_by_hand():
    logits = th.zeros(2, requires_grad=True)
    # The first agent's logits in all four joint actions, each of the same probability
    both = th.stack([logits.expand(4, 2), th.zeros(4, 2)], dim=1)
    distribution = JointDistribution(both, th.ones(4, 2, 2, dtype=th.bool))
    advantages = counterfactual_advantages(exact_values(JOINT), distribution.probs, JOINT)
    assert advantages[:, 0].tolist() == pytest.approx([2, -1, -2, 1]) and not advantages.requires_grad
    only_first = th.tensor([[1.0, 0.0]]).expand(4, 2)
    coma_actor_loss(distribution, JOINT, advantages, only_first, 0.0).backward()
    assert logits.grad is not None and -logits.grad[0].item() == pytest.approx(0.25)
    # The gradient of the expected payoff J itself
    chances = logits.detach().clone().requires_grad_()
    (chances.softmax(0) @ PAYOFFS @ th.full((2,), 0.5)).backward()
    assert chances.grad is not None and chances.grad[0].item() == pytest.approx(0.25)


def test_the_luck_of_others_is_no_noise():
    rng = th.Generator().manual_seed(0)
    right = th.randint(2, (20_000, 5), generator=rng)
    total = right.sum(dim=1, keepdim=True)
    # Action 0 is wrong and 1 right for each; an exact critic knows how many of the others are right
    q = th.stack([total - right, total - right + 1], dim=-1).float()
    advantages = counterfactual_advantages(q, th.full_like(q, 0.5), right)
    first_right = right[:, 0] == 1
    assert advantages[first_right, 0].var() == 0 and advantages[first_right, 0].mean() == 0.5
    assert (total.float() - 2.5)[first_right, 0].var() == pytest.approx(1, abs=0.03)


def test_illegal_actions_are_never_drawn_and_count_for_nothing():
    mask = th.tensor([[[True, True, False], [False, True, False]]])
    logits = th.tensor([[[1.0, 1.0, 50.0], [9.0, 1.0, 9.0]]], requires_grad=True)
    distribution = JointDistribution(logits, mask)
    assert th.allclose(distribution.probs, th.tensor([[[0.5, 0.5, 0.0], [0.0, 1.0, 0.0]]]))
    assert distribution.entropy().tolist() == [pytest.approx([np.log(2), 0], abs=1e-6)]
    assert distribution.sample(deterministic=True).tolist() == [[0, 1]]
    many = JointDistribution(logits.expand(500, 2, 3), mask.expand(500, 2, 3)).sample()
    assert sorted(many[:, 0].unique().tolist()) == [0, 1] and many[:, 1].unique().tolist() == [1]
    actions = th.tensor([[0, 1]])
    q = th.tensor([[[3.0, 1.0, 0.0], [0.0, 7.0, 0.0]]])
    raised = q + 1000 * (~mask)
    for values in (q, raised):
        assert counterfactual_advantages(values, distribution.probs, actions).tolist() == [[1.0, 0.0]]
    coma_actor_loss(distribution, actions, th.tensor([[1.0, 0.0]]), th.ones(1, 2), 0.1).backward()
    assert logits.grad is not None and logits.grad.isfinite().all() and not logits.grad[~mask].any()


def test_the_critic_sees_what_the_others_do_and_not_the_agents_own_action():
    policy = learner().policy
    obs, _ = policy.obs_to_tensor(joint_env(n_envs=3).reset())
    at = policy.critic_values(policy.critic, obs, th.tensor([[0, 0], [1, 0], [0, 1]]))
    assert th.equal(at[0, 0], at[1, 0]) and not th.equal(at[0, 1], at[1, 1])
    assert th.equal(at[0, 1], at[2, 1]) and not th.equal(at[0, 0], at[2, 0])
    obs["state"] += 1
    assert not th.equal(policy.critic_values(policy.critic, obs, th.zeros(3, 2, dtype=th.int64))[0, 0], at[0, 0])


def test_actors_do_not_see_the_state():
    policy = learner().policy
    obs, _ = policy.obs_to_tensor(joint_env().reset())
    at = policy.distribution(obs).probs
    obs["state"] += 1
    assert th.equal(policy.distribution(obs).probs, at)
    obs["obs"][:, 0] += 1
    assert not th.equal(policy.distribution(obs).probs[0, 0], at[0, 0])
    assert th.equal(policy.distribution(obs).probs[0, 1], at[0, 1])


def rollout(truncates, **kwargs):
    """Collect a rollout of two episodes, and return the learner with it."""
    model = learner(joint_env(n_envs=1, truncates=truncates), **kwargs)
    model._setup_learn(6)
    assert model.env is not None
    _, callback = model._setup_learn(6)
    model.collect_rollouts(model.env, callback, model.rollout_buffer, 6)
    return model


@pytest.mark.parametrize("truncates", [False, True])
def test_returns_are_those_of_td_lambda(truncates):
    model = rollout(truncates)
    buffer, policy = model.rollout_buffer, model.policy
    obs, _ = policy.obs_to_tensor({key: part[:, 0] for key, part in buffer.observations.items()})
    actions = th.as_tensor(buffer.actions[:, 0]).long()
    with th.no_grad():
        values = taken(policy.critic_values(policy.critic_target, obs, actions), actions).mean(-1).numpy()
    assert values == pytest.approx(buffer.values[:, 0], abs=1e-5)
    # "a" gets its own action, "b" 2
    rewards = (buffer.actions[:, 0, 0] + 2) / 2
    returns = buffer.returns[:, 0]
    for t in (0, 1, 3, 4):
        assert returns[t] == pytest.approx(rewards[t] + 0.99 * (0.2 * values[t + 1] + 0.8 * returns[t + 1]), abs=1e-4)
    ends = returns[[2, 5]] - rewards[[2, 5]]
    assert ends == pytest.approx(0, abs=1e-6) if not truncates else (np.abs(ends) > 1e-4).all()


def test_where_a_limit_cuts_off_an_action_is_drawn_and_not_taken():
    policy = learner().policy
    obs, _ = policy.obs_to_tensor(joint_env(n_envs=1).reset())
    q = policy.critic_values(policy.critic_target, obs, th.zeros(1, 2, dtype=th.int64))
    drawn = {round(policy.predict_values(obs).item(), 5) for _ in range(60)}
    assert 2 <= len(drawn) <= 4 and q.shape == (1, 2, 3), "one for each of the four legal joint actions"


def test_who_is_out_of_play_does_not_train_the_actors():
    distribution = JointDistribution(th.zeros(2, 2, 2, requires_grad=True), th.ones(2, 2, 2, dtype=th.bool))
    actions, in_play = th.zeros(2, 2, dtype=th.int64), th.tensor([[1.0, 0.0], [1.0, 1.0]])
    at = coma_actor_loss(distribution, actions, th.tensor([[1.0, 5.0], [1.0, 1.0]]), in_play, 0.0)
    assert at.item() == pytest.approx(np.log(2))
    assert coma_actor_loss(distribution, actions, th.tensor([[1.0, -99.0], [1.0, 1.0]]), in_play, 0.0) == at
    model = learner(joint_env(n_envs=2, dies=1)).learn(12)
    assert np.array(model._in_play)[:, 0].tolist() == [[True, True], [True, False], [True, False]] * 2


def test_one_critic_step_for_each_time_step_the_last_first(monkeypatch):
    model, seen = learner(target_update_interval=4), []
    step = model._critic_step

    def record(obs, actions, returns):
        seen.append(obs["state"][0, 0].item())
        return step(obs, actions, returns)

    monkeypatch.setattr(model, "_critic_step", record)
    model.learn(12)
    assert seen == [2, 1, 0, 2, 1, 0] and model._n_updates == 1
    online, target = (list(net.parameters()) for net in (model.policy.critic, model.policy.critic_target))
    assert not th.equal(online[0], target[0])
    model.learn(12, reset_num_timesteps=False)
    assert model._n_critic_steps == 12 and th.equal(online[0], target[0])


def test_is_saved_and_learns_on(tmp_path):
    model = learner().learn(36)
    model.save(tmp_path / "model")
    loaded = COMA.load(tmp_path / "model", env=joint_env(n_envs=2))
    assert th.equal(parameters(loaded), parameters(model))
    ours, theirs = (each.policy.critic_optimizer.state_dict()["state"][0]["square_avg"] for each in (model, loaded))
    assert th.equal(ours, theirs)
    assert evaluate_policy(model, joint_env(), 2) == evaluate_policy(loaded, joint_env(), 2)
    loaded.learn(12, reset_num_timesteps=False)
    assert loaded.num_timesteps == 48 and not th.equal(parameters(loaded), parameters(model))


def test_a_resumed_training_is_the_undisturbed_one():
    def make_env():
        return joint_team(make_team_env(CountingTeam, n_envs=2, seed=0))

    whole, callback = Team(COMA, "ComaPolicy", make_env(), seed=0, n_steps=4), SaveOnce(at=32)
    whole.learn(96, callback=callback)
    resumed = Team.load(io.BytesIO(callback.saved), env=make_env(), exact=True)
    resumed.learn(96 - resumed.num_timesteps, callback=SaveOnce(), reset_num_timesteps=False)
    assert th.equal(parameters(whole.agents["team"]), parameters(resumed.agents["team"]))


@pytest.mark.parametrize(
    "kwargs", [{"n_steps": 0}, {"gamma": -1}, {"td_lambda": 1.5}, {"ent_coef": -0.1}, {"target_update_interval": 0}]
)
def test_arguments_out_of_range(kwargs):
    with pytest.raises(ValueError, match=f"{next(iter(kwargs))}="):
        learner(**kwargs)


def test_other_environments_are_refused():
    with pytest.raises(ValueError, match="shown as one"):
        learner(make_team_env(CountingTeam, n_envs=1))
