"""MADDPG: its gradients by hand, targets, ends, masks, files, and a short training on another package's environment."""
# mypy: disable-error-code="arg-type, operator"

import io

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.evaluation import evaluate_policy
from torch import nn

from sb3_belief.references.joint_replay import JointSamples
from sb3_belief.references.joint_vec_env import JointVecEnv, joint_team
from sb3_belief.references.maddpg import MADDPG
from tests.references.counting_team import CountingTeam, joint_env
from tests.references.test_joint_vec_env import BoxTeam
from tests.team.exact.test_exact import SaveOnce
from tests.team.helpers import Team, make_team_env, parameters

SMALL = {"batch_size": 8, "learning_starts": 4, "train_freq": 2, "buffer_size": 200, "seed": 0}


def learner(env=None, **kwargs):
    return MADDPG("MaddpgPolicy", joint_env(n_envs=2) if env is None else env, **{**SMALL, **kwargs})


class OneNumberTeam(CountingTeam):
    """Two agents, each of which gives a number in [-1, 1]."""

    def __init__(self):
        super().__init__(masks=False)
        self._action_spaces = {agent: spaces.Box(-1, 1, (1,)) for agent in self.possible_agents}

    def step(self, actions):
        return super().step({"a": 0})


def test_the_gradient_by_hand(monkeypatch):
    model = learner(JointVecEnv(make_team_env(OneNumberTeam, n_envs=1)), output_coef=0.0)
    policy = model.policy
    theta = th.tensor([0.2, -0.7], requires_grad=True)
    # Actors that say theta, and critics that know that the actions should add up to one
    monkeypatch.setattr(policy, "outputs", lambda actors, obs: theta.atanh().reshape(1, 2, 1))
    monkeypatch.setattr(policy, "critic_values", lambda critics, state, actions: -((actions.sum(dim=(-1, -2)) - 1) ** 2).T)
    assert model.env is not None
    obs = policy.obs_to_tensor(model.env.reset())[0]
    first = th.tensor([[1.0, 0.0]])
    samples = JointSamples(obs, th.tensor([[-0.3, 0.5]]), obs, th.zeros(1, 2), th.zeros(1, 2), first, first)
    loss = model.actor_loss(samples)
    loss.backward()
    assert loss.item() == pytest.approx(0.09, abs=1e-5)
    assert theta.grad is not None and theta.grad.tolist() == pytest.approx([-0.6, 0], abs=1e-4)
    # The second agent's loss is that of its own action beside the first one's replayed one
    both = model.actor_loss(samples._replace(in_play=th.ones(1, 2)))
    assert both.item() == pytest.approx(0.09 + 2.0**2, abs=1e-4)


def test_large_outputs_cost_something():
    model = learner(output_coef=0.0)
    model.learn(8)
    samples = model.replay_buffer.sample(8)
    th.manual_seed(0)
    at = model.actor_loss(samples)
    model.output_coef = 0.5
    th.manual_seed(0)
    outputs = model.policy.outputs(model.policy.actors, samples.observations)
    legal = samples.observations["mask"].bool()
    squares = [(outputs[b, i][legal[b, i]] ** 2).mean() for b in range(8) for i in range(2)]
    assert model.actor_loss(samples).item() == pytest.approx(at.item() + 0.5 * sum(squares).item() / 8, rel=1e-4)


def test_only_the_right_targets_move():
    model = learner(joint_env(n_envs=2, truncates=True)).learn(24)
    samples = model.replay_buffer.sample(8)

    def targets(**changes):
        th.manual_seed(0)
        return model.targets(samples._replace(**changes))

    at = targets()
    changed = samples.rewards.clone()
    changed[3, 1] += 1
    moved = targets(rewards=changed) - at
    assert moved[3].tolist() == pytest.approx([0, 1]) and (moved != 0).sum() == 1
    ends = samples.ends.clone()
    ends[2, 0] = 1
    moved = targets(ends=ends) != at
    assert moved[2].tolist() == [True, False] and moved.sum() == 1
    assert targets(ends=ends)[2, 0] == samples.rewards[2, 0]
    # An illegal action's logit changes nothing: "b" may take its third action only at the end
    model.policy.actor_targets[-1].bias.data[1, 0, 2] -= 100
    legal = samples.next_observations["mask"][:, 1, 2].bool()
    assert not (targets() != at)[~legal].any() and legal.any()


def test_each_agent_has_rewards_and_ends_of_its_own():
    model = learner(joint_env(n_envs=1, dies=2, masks=False), train_freq=100).learn(6)
    buffer = model.replay_buffer
    assert buffer.own_rewards[:6, 0, 1].tolist() == [2] * 6
    assert buffer.own_rewards[:6, 0, 0].tolist() == buffer.actions[:6, 0, 0].tolist()
    assert buffer.own_ends[:6, 0].tolist() == [[0, 0], [0, 1], [1, 1]] * 2
    assert buffer.in_play[:6, 0].tolist() == [[1, 1], [1, 1], [1, 0]] * 2
    cut = learner(joint_env(n_envs=1, truncates=True), train_freq=100).learn(3)
    assert not cut.replay_buffer.own_ends[:3].any()
    assert cut.replay_buffer.next_observations["state"][2, 0].tolist() == [3, 30]


class RunsOn(CountingTeam):
    """As where the team's reward is everybody's: "b" is dead after step 1, and its return runs on."""

    def _infos(self):
        infos = super()._infos()
        return {**infos, "b": {**infos["b"], "active": self.t <= 1, "next_active": self.t < 1}}


def test_the_critic_of_a_dead_agent_learns_while_its_return_runs_on():
    model = learner(JointVecEnv(make_team_env(RunsOn, n_envs=1)), train_freq=1, learning_starts=100)
    model.learn(2)
    # As if the environment had been left in the middle of an episode, in which "b" was dead
    model.learn(6)
    buffer = model.replay_buffer
    assert buffer.in_play[:8, 0, 1].tolist() == [1, 0] + [1, 0, 0] * 2
    assert buffer.return_runs[:8, 0].all()
    samples = buffer._get_samples(np.arange(2, 5))

    def losses(rewards):
        th.manual_seed(0)
        asked = samples._replace(rewards=rewards)
        return model.critic_loss(asked).item(), model.actor_loss(asked).item()

    later = samples.rewards.clone()
    later[1:, 1] += 1000
    (critic, actor), (critic_before, actor_before) = losses(later), losses(samples.rewards)
    assert critic > critic_before + 1000 and actor == actor_before


def test_steps_before_the_first_life_train_nobody():
    class Joins(CountingTeam):
        """The second agent joins at step 2."""

        def _infos(self):
            infos = super()._infos()
            return {**infos, "b": {**infos["b"], "active": self.t > 1, "next_active": self.t > 0}}

    buffer = learner(JointVecEnv(make_team_env(Joins, n_envs=1)), train_freq=100, learning_starts=100).learn(6).replay_buffer
    assert buffer.return_runs[:6, 0, 1].tolist() == buffer.in_play[:6, 0, 1].tolist() == [0, 1, 1] * 2


def test_agents_share_nothing():
    model = learner(output_coef=0.0).learn(8)
    policy = model.policy
    samples = model.replay_buffer.sample(8)
    policy.optimizer.zero_grad()
    model.actor_loss(samples._replace(in_play=th.tensor([[1.0, 0.0]]).expand(8, 2))).backward()
    for parameter in policy.actors.parameters():
        assert parameter.grad is not None and parameter.grad[0].any() and not parameter.grad[1].any()
    obs, _ = policy.obs_to_tensor(joint_env().reset())
    at = policy.outputs(policy.actors, obs)
    obs["state"] += 1
    obs["obs"][:, 1] += 1
    after = policy.outputs(policy.actors, obs)
    assert th.equal(after[:, 0], at[:, 0]) and not th.equal(after[:, 1], at[:, 1])


def test_gradients_are_clipped_for_each_agent():
    model = learner(max_grad_norm=0.5)
    network: nn.Module = model.policy.actors
    optimizer = th.optim.SGD(network.parameters(), lr=1.0)
    before = [parameter.detach().clone() for parameter in network.parameters()]
    scale = th.tensor([100.0, 1e-3])[:, None, None]
    model._step(optimizer, sum((scale * parameter).sum() for parameter in network.parameters()), network)
    steps = [(old - new).flatten(1) for old, new in zip(before, network.parameters(), strict=True)]
    norms = th.cat(steps, dim=1).norm(dim=1)
    n_parameters = sum(step.shape[1] for step in steps)
    assert norms.tolist() == pytest.approx([0.5, 1e-3 * n_parameters**0.5], rel=1e-2)


def test_hard_legal_samples_with_a_gradient():
    policy = learner().policy
    obs, _ = policy.obs_to_tensor(joint_env(n_envs=1).reset())
    obs = {key: part.expand(400, *part.shape[1:]) for key, part in obs.items()}
    outputs = policy.outputs(policy.actors, obs)
    actions = policy.act(outputs)
    assert set(actions.unique().tolist()) == {0.0, 1.0} and (actions.sum(-1) == 1).all()
    assert not actions[~obs["mask"].bool()].any() and actions[:, 0].mean(0)[:2].min() > 0.2
    actions[..., 0].sum().backward()
    assert all(parameter.grad is not None and parameter.grad.isfinite().all() for parameter in policy.actors.parameters())
    best = policy.act(outputs, deterministic=True)
    assert th.equal(best.argmax(-1), outputs.argmax(-1))


@pytest.mark.parametrize("team", [CountingTeam, BoxTeam])
def test_learns_acts_and_is_saved(team, tmp_path):
    def env():
        return JointVecEnv(make_team_env(team, n_envs=2))

    model = learner(env())
    before = parameters(model)
    model.learn(40)
    assert model._n_updates == 9 and not th.equal(parameters(model), before) and parameters(model).isfinite().all()
    model.save(tmp_path / "model")
    loaded = MADDPG.load(tmp_path / "model", env=env())
    assert th.equal(parameters(loaded), parameters(model))
    assert evaluate_policy(model, env(), 2) == evaluate_policy(loaded, env(), 2)
    loaded.learn(12, reset_num_timesteps=False)
    assert loaded.num_timesteps == 52


def test_box_actions_have_noise_in_training_alone():
    model = learner(JointVecEnv(make_team_env(BoxTeam, n_envs=2)), exploration_noise=0.3)
    model._setup_learn(10)
    actions = np.array([model._sample_action(0, model.action_noise, 2)[1] for _ in range(400)])
    assert actions.shape == (400, 2, 2, 2) and actions.std(axis=0) == pytest.approx(np.full((2, 2, 2), 0.3), abs=0.06)
    obs = model._last_obs
    assert np.array_equal(model.predict(obs)[0], model.predict(obs)[0])


@pytest.mark.parametrize("team", [CountingTeam, OneNumberTeam])
def test_a_resumed_training_is_the_undisturbed_one(team):
    def make_env():
        return joint_team(make_team_env(team, n_envs=2, seed=0))

    whole, callback = Team(MADDPG, "MaddpgPolicy", make_env(), **SMALL), SaveOnce(at=32)
    whole.learn(96, callback=callback)
    resumed = Team.load(io.BytesIO(callback.saved), env=make_env(), exact=True)
    resumed.learn(96 - resumed.num_timesteps, callback=SaveOnce(), reset_num_timesteps=False)
    assert th.equal(parameters(whole.agents["team"]), parameters(resumed.agents["team"]))


@pytest.mark.parametrize(
    "kwargs",
    [{"batch_size": 0}, {"gradient_steps": 0}, {"tau": 2.0}, {"gamma": -1}, {"exploration_noise": -1}, {"output_coef": -1}],
)
def test_arguments_out_of_range(kwargs):
    with pytest.raises(ValueError, match=f"{next(iter(kwargs))}="):
        learner(**kwargs)


@pytest.mark.parametrize("continuous", [False, True])
def test_learns_in_simple_spread(continuous):
    pytest.importorskip("mpe2")
    kwargs = {"continuous_actions": continuous}
    env = JointVecEnv(make_team_env("mpe/simple_spread_v3", n_envs=4, seed=0, env_kwargs=kwargs))
    model = MADDPG("MaddpgPolicy", env, seed=0, batch_size=64, learning_starts=100, train_freq=10).learn(400)
    assert model._n_updates == 8 and parameters(model).isfinite().all()


@pytest.mark.parametrize("copies", [1, 3])
def test_a_saved_one_of_numbers_goes_on_in_another_number_of_copies(copies, tmp_path):
    def env(n):
        return JointVecEnv(make_team_env(BoxTeam, n_envs=n))

    learner(env(2)).learn(12).save(tmp_path / "model")
    loaded = MADDPG.load(tmp_path / "model", env=env(copies))
    assert loaded.learn(12, reset_num_timesteps=False).num_timesteps == 24


def test_numbers_are_drawn_evenly_before_the_first_update():
    model = learner(JointVecEnv(make_team_env(BoxTeam, n_envs=2)), learning_starts=400, exploration_noise=1e-6)
    model.learn(400)
    # It has come round
    actions = model.replay_buffer.actions
    spread = actions.std(axis=(0, 1))
    assert spread[spread > 0].min() > 0.5 and abs(actions).max() > 0.95
