"""RODE: groups of actions, roles and their returns, acting in roles, files."""
# mypy: disable-error-code="arg-type, operator"

import io
import itertools

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_belief.references.agent_net import AgentValues
from sb3_belief.references.joint_vec_env import JointVecEnv, joint_team
from sb3_belief.references.rode import RODE
from sb3_belief.references.rode_policy import RodeValue
from sb3_belief.references.roles import ActionEffects, group_actions
from tests.references.counting_team import CountingTeam, UnequalTeam, joint_env, recorded_logs
from tests.team.exact.test_exact import SaveOnce
from tests.team.helpers import Team, make_team_env, parameters

SMALL = {"batch_size": 2, "buffer_size": 20, "seed": 0, "role_start": 12}


def learner(env=None, **kwargs):
    own = {"n_roles": 2, "role_interval": 2, "hidden_dim": 8, **kwargs.pop("policy_kwargs", {})}
    return RODE("RodePolicy", joint_env(n_envs=2) if env is None else env, policy_kwargs=own, **{**SMALL, **kwargs})


def test_actions_of_like_effects_get_like_embeddings():
    th.manual_seed(0)
    effects = ActionEffects(n_agents=2, obs_dim=2, n_actions=4)
    optimizer = th.optim.Adam(effects.parameters(), lr=1e-2)
    for _ in range(150):
        obs, actions = th.rand(64, 2, 2), th.randint(4, (64, 2))
        # The actions 0 and 2 move an agent to the right, 1 and 3 upwards, and "1" of both pays
        moved = obs + th.nn.functional.one_hot(actions % 2, 2)
        loss = effects.loss(obs, actions, moved, (actions % 2).prod(dim=1).float())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    roles = group_actions(effects.embeddings().detach().numpy(), 2, np.random.default_rng(0))
    assert roles.tolist() == [[True, False, True, False], [False, True, False, True]]


def test_the_loss_of_effects_by_hand():
    effects = ActionEffects(n_agents=2, obs_dim=2, n_actions=3)
    for network, value in ((effects.next_obs, 1.0), (effects.reward, 2.0)):
        network[-1].weight.data.zero_()
        network[-1].bias.data.fill_(value)
    obs, next_obs = th.zeros(1, 2, 2), th.tensor([[[1.0, 1.0], [4.0, 5.0]]])
    # Errors of 0 and 5 in the observations, and of 1 in the reward
    loss = effects.loss(obs, th.zeros(1, 2, dtype=th.int64), next_obs, th.tensor([3.0]))
    assert loss.item() == pytest.approx((0 + 5) / 2 + 10)


@pytest.mark.parametrize("seed", range(5))
def test_groups_by_hand(seed):
    points = np.array([[0.0], [5.0], [0.2], [5.1], [0.1]])
    groups = group_actions(points, 2, np.random.default_rng(seed))
    assert groups.tolist() == [[True, False, True, False, True], [False, True, False, True, False]]
    # A role of the action 1 alone takes in the nearest of the others
    alone = group_actions(np.array([[0.0], [9.0], [1.0]]), 2, np.random.default_rng(seed))
    assert alone.tolist() == [[True, False, True], [False, True, True]]
    assert group_actions(points, 1, np.random.default_rng(seed)).all()
    each = group_actions(np.arange(4.0)[:, None] ** 2, 4, np.random.default_rng(seed))
    assert [row.argmax() for row in each] == [0, 0, 1, 2] and (each.sum(axis=1) == 2).all()
    assert (group_actions(np.zeros((4, 2)), 2, np.random.default_rng(seed)).any(axis=0)).all()


def test_roles_are_made_once_and_the_replay_begins_anew():
    model = learner().learn(12)
    assert model.policy.has_roles and model.replay_buffer.size() == 0 and not model.policy.action_embeddings.eq(0).all()
    embeddings, grouped = model.policy.action_embeddings.clone(), model.policy.role_actions.clone()
    effects = [parameter.detach().clone() for parameter in model.policy.effects.parameters()]
    model.learn(36, reset_num_timesteps=False)
    assert th.equal(model.policy.action_embeddings, embeddings) and th.equal(model.policy.role_actions, grouped)
    assert all(th.equal(old, new) for old, new in zip(effects, model.policy.effects.parameters(), strict=True))
    assert model.replay_buffer.size() == 12
    expected = [embeddings[actions].mean(dim=0) for actions in grouped]
    assert th.allclose(model.policy.role_embeddings, th.stack(expected), atol=1e-6)


def test_it_plays_at_random_until_there_are_roles_and_epsilon_begins_there():
    model = learner(exploration_initial_eps=0.8, exploration_final_eps=0.2, exploration_steps=20).learn(10)
    assert model.exploration_rate == 1 and not model.policy.has_roles
    model.learn(12, reset_num_timesteps=False)
    assert model.exploration_rate == pytest.approx(0.5)


def with_roles(**kwargs):
    """A learner whose roles are the actions {0, 1} and {2}, not learned."""
    model = learner(**kwargs)
    policy = model.policy
    th.manual_seed(0)
    policy.action_embeddings.normal_()
    policy.role_embeddings.normal_()
    policy.role_actions.copy_(th.tensor([[True, True, False], [False, False, True]]))
    policy.has_roles.fill_(True)
    return model


def test_a_role_is_kept_for_its_steps_and_its_legal_actions_are_played():
    model = with_roles()
    obs = {key: np.repeat(part, 50, axis=0) for key, part in joint_env(masks=False).reset().items()}
    model.exploration_rate, state, kept = 1.0, None, []
    for _ in range(6):
        actions, state = model.predict(obs, state)
        roles = state[2]
        # "a" has no third action: in the second role all of its legal actions are left
        assert (actions[:, 1][roles[:, 1] == 1] == 2).all() and (actions[:, 1][roles[:, 1] == 0] < 2).all()
        assert (actions[:, 0] < 2).all()
        kept.append(roles)
    assert all(np.array_equal(kept[t], kept[t + 1]) for t in (0, 2, 4))
    assert not np.array_equal(kept[1], kept[2]) and (kept[0][:, 0] != kept[0][:, 1]).any()
    _, after = model.predict(obs, state, np.ones(50, dtype=bool), deterministic=True)
    fresh = model.predict(obs, deterministic=True)[1]
    assert all(np.allclose(one, other) for one, other in zip(after, fresh, strict=True))


def test_returns_of_roles_by_hand():
    for truncates in (False, True):
        env = joint_env(n_envs=2, truncates=truncates, length=5)
        model = with_roles(env=env, batch_size=2, role_start=1, learning_rate=0.0, policy_kwargs={"recurrent": False})
        model.learn(20)
        batch = model.replay_buffer.batch(model.replay_buffer.episodes[:1])
        of_roles, _ = model.role_targets(batch)
        policy = model.policy
        values, features = policy.pass_episodes(policy.target_net, batch)
        best = values.max(dim=-1).indices
        flat = values.flatten(0, 1), features.flatten(0, 1), batch.state.flatten(0, 1)
        joint = policy.target_net.role_mixer.joint_value(AgentValues(*flat), best.flatten(0, 1))[:, 0]
        rewards, gamma = batch.rewards[0], 0.99
        assert of_roles[0, 0].item() == pytest.approx((rewards[0] + gamma * rewards[1] + gamma**2 * joint[2]).item(), rel=1e-4)
        assert of_roles[0, 2].item() == pytest.approx((rewards[2] + gamma * rewards[3] + gamma**2 * joint[4]).item(), rel=1e-4)
        last = rewards[4] + (gamma * joint[5] if truncates else 0)
        assert of_roles[0, 4].item() == pytest.approx(last.item(), rel=1e-4)


@pytest.mark.parametrize("length", [4, 5])
def test_targets_of_actions_by_hand(length):
    """The next step's actions are those of its role: the one that was chosen; after a cut the one that would have been."""
    env = joint_env(n_envs=8, truncates=True, length=length)
    model = with_roles(env=env, batch_size=2, role_start=1, learning_rate=0.0, policy_kwargs={"recurrent": False})
    model.learn(8 * length)
    batch, policy = model.replay_buffer.batch(model.replay_buffer.episodes[:8]), model.policy
    # So that double Q differs from taking the target network's best
    with th.no_grad():
        for parameter in policy.target_net.parameters():
            parameter.add_(th.randn_like(parameter))
    _, found = model.role_targets(batch)
    role_values, features = policy.pass_episodes(policy.net, batch)
    _, target_features = policy.pass_episodes(policy.target_net, batch)
    differ = {"role": False, "action": False}
    for episode, t in itertools.product(range(8), range(length)):
        after, kept = slice(t + 1, t + 2), batch.actions[episode, t, :, 1]
        if t + 1 < length:
            role = batch.actions[episode, t + 1, :, 1]
        else:
            # A role is kept for two steps: after four of them another would be chosen, after five not yet
            role = role_values[episode, length].argmax(dim=-1) if length == 4 else kept
            differ["role"] |= bool((role != kept).any())
        parts = role[None], batch.mask[episode, after], batch.state[episode, after]
        of_target = policy.values_in(policy.target_net, target_features[episode, after], *parts)
        best = policy.values_in(policy.net, features[episode, after], *parts).greedy()
        differ["action"] |= bool((best != of_target.greedy()).any())
        value = policy.target_net.action_mixer.joint_value(of_target, best).squeeze()
        assert found[episode, t].item() == pytest.approx((batch.rewards[episode, t] + 0.99 * value).item(), rel=1e-4)
    assert differ == {"role": length == 4, "action": True}


def test_only_the_right_targets_move():
    model = with_roles(role_start=1)
    model.learn(12)
    batch = model.replay_buffer.batch(model.replay_buffer.episodes[:2])
    at = model.role_targets(batch)

    def moved(which, **changes):
        return ((model.role_targets(batch._replace(**changes))[which] - at[which]).abs() > 1e-6).tolist()

    rewards = batch.rewards.clone()
    rewards[0, 1] += 1
    # A role's return is that of its two steps
    assert moved(0, rewards=rewards) == [[True, True, False], [False] * 3]
    assert moved(1, rewards=rewards) == [[False, True, False], [False] * 3]
    ends = batch.ends.clone()
    ends[1, 2] = 0
    assert moved(0, ends=ends) == moved(1, ends=ends) == [[False] * 3, [False, False, True]]


def test_values_of_illegal_actions_count_for_nothing(monkeypatch):
    model = with_roles(env=joint_env(n_envs=2, truncates=True), role_start=1)
    model.learn(12)
    batch = model.replay_buffer.batch(model.replay_buffer.episodes[:2])
    assert not batch.mask[:, :3, 1, 2].any() and batch.mask[:, 3, 1, 2].all(), "legal in the last observation alone"
    # All stay in the role of this action; where it is not legal, the role has none, and all legal ones may be chosen
    batch.actions[..., 1], model.policy.role_interval = 1, 9
    of_roles, of_actions = model.role_targets(batch)
    values_of = RodeValue.action_values
    # The value of this action is raised everywhere
    monkeypatch.setattr(RodeValue, "action_values", lambda *args: values_of(*args) + 100 * th.eye(3)[2])
    of_roles_then, of_actions_then = model.role_targets(batch)
    assert th.equal(of_roles_then, of_roles)
    assert ((of_actions_then - of_actions).abs() > 1e-3).tolist() == [[False, False, True]] * 2


@pytest.mark.parametrize("recurrent", [True, False])
def test_learns_acts_and_is_saved(recurrent, tmp_path):
    model = learner(policy_kwargs={"recurrent": recurrent})
    before = parameters(model)
    model.learn(48)
    assert not th.equal(parameters(model), before) and parameters(model).isfinite().all()
    model.save(tmp_path / "model")
    loaded = RODE.load(tmp_path / "model", env=joint_env(n_envs=2))
    assert th.equal(parameters(loaded), parameters(model)) and loaded.policy.has_roles
    assert th.equal(loaded.policy.role_actions, model.policy.role_actions)
    assert evaluate_policy(model, joint_env(), 2) == evaluate_policy(loaded, joint_env(), 2)
    loaded.learn(12, reset_num_timesteps=False)
    assert loaded.num_timesteps == 60


# After 10 and 34 steps the next one ends an episode
@pytest.mark.parametrize("at", [8, 10, 32, 34])
def test_a_resumed_training_is_the_undisturbed_one(at):
    def make_env():
        return joint_team(make_team_env(CountingTeam, n_envs=2, seed=0))

    own = {"policy_kwargs": {"n_roles": 2, "role_interval": 2, "hidden_dim": 8}}
    whole, callback = Team(RODE, "RodePolicy", make_env(), **own, **SMALL), SaveOnce(at=at)
    whole.learn(96, callback=callback)
    resumed = Team.load(io.BytesIO(callback.saved), env=make_env(), exact=True)
    resumed.learn(96 - resumed.num_timesteps, callback=SaveOnce(), reset_num_timesteps=False)
    assert th.equal(parameters(whole.agents["team"]), parameters(resumed.agents["team"]))


def test_what_makes_no_sense_is_refused():
    with pytest.raises(ValueError, match="n_roles=4 must be from 1 to 3"):
        learner(policy_kwargs={"n_roles": 4})
    with pytest.raises(ValueError, match="role_start=0"):
        learner(role_start=0)
    with pytest.raises(ValueError, match="RODE learns in a team's environment shown as one"):
        learner(make_team_env(CountingTeam, n_envs=1))


def test_roles_of_levers_are_found_before_anything_is_won():
    env = JointVecEnv(make_team_env("levers", n_envs=8, seed=0))
    own = {"n_roles": 2, "recurrent": False}
    model = RODE("RodePolicy", env, role_start=4000, learning_rate=2e-3, seed=0, policy_kwargs=own).learn(4000)
    assert model.policy.role_actions.tolist() == [[True] * 3 + [False] * 3, [False] * 3 + [True] * 3]


def test_steps_that_are_counted_anew_give_no_probability_above_one():
    model = with_roles()
    model.learn(4)
    assert model.exploration_rate == 1.0


def test_the_schedule_of_the_learning_rate_holds_for_the_effects():
    model = learner(learning_rate=lambda left: 1e-3 * left, role_start=1000)
    model.learn(48)
    rates = [group["lr"] for optimizer in model._optimizers for group in optimizer.param_groups]
    assert len(rates) == 2 and rates[0] == rates[1] < 1e-4


def test_roles_wait_for_embeddings_that_have_been_trained():
    model = learner(batch_size=8, role_start=6)
    model.learn(12)
    assert not model._n_updates and not model.policy.has_roles
    model.learn(60, reset_num_timesteps=False)
    assert model._n_updates and model.policy.has_roles


@pytest.mark.parametrize("kwargs", [{}, {"truncates": True}, {"nothing": True}], ids=["ends", "limits", "nothing is legal"])
def test_steps_that_do_not_exist_may_have_any_masks(kwargs):
    model = learner(JointVecEnv(make_team_env(lambda: UnequalTeam(**kwargs), n_envs=2)), batch_size=4, role_start=20)
    logs = recorded_logs(model)
    model.learn(120)
    assert any("role_loss" in log for log in logs) and np.isfinite([value for log in logs for value in log.values()]).all()
    assert th.as_tensor(parameters(model)).isfinite().all()
