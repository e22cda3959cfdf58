"""Whole updates of joint learners against the same steps taken by hand: that what is tested piece by piece is used."""
# mypy: disable-error-code="arg-type, operator"

from copy import deepcopy
from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_belief.references.coma import COMA
from sb3_belief.references.factorisation import ValueFactorisation
from sb3_belief.references.maddpg import MADDPG
from tests.references.counting_team import joint_env
from tests.references.test_rode import with_roles

RATE = 1e-3
SGD: dict[str, Any] = {"optimizer_class": th.optim.SGD, "optimizer_kwargs": {}}


def descend(network: Any, loss: th.Tensor) -> None:
    """Take a step of gradient descent."""
    parameters = list(network.parameters())
    for parameter, gradient in zip(parameters, th.autograd.grad(loss, parameters), strict=True):
        with th.no_grad():
            parameter -= RATE * gradient


def close(found: Any, expected: Any) -> bool:
    pairs = list(zip(found.parameters(), expected.parameters(), strict=True))
    return all(th.allclose(a, b, atol=2e-7, rtol=1e-6) for a, b in pairs)


def test_coma():
    env = joint_env(n_envs=1, dies=2)
    model = COMA(
        "ComaPolicy",
        env,
        n_steps=6,
        seed=0,
        learning_rate=RATE,
        max_grad_norm=1e9,
        ent_coef=0.3,
        policy_kwargs=SGD,
        device="cpu",
    )
    for parameter in model.policy.critic_target.parameters():
        # So that it matters which critic the advantages are of
        parameter.data.mul_(-1.0)
    before, train = deepcopy(model.policy), model.train
    kept: dict[str, Any] = {}
    first = [parameter.detach().clone() for parameter in model.policy.actor.parameters()]

    def watched() -> None:
        buffer: Any = model.rollout_buffer
        kept.update({key: part.copy() for key, part in buffer.observations.items()})
        kept.update(actions=buffer.actions.copy(), returns=buffer.returns.copy())
        train()

    model.train = watched  # type: ignore[method-assign]
    model.learn(6)
    obs = {key: th.as_tensor(kept[key][:, 0]).float() for key in ("obs", "state", "mask")}
    actions, returns = th.as_tensor(kept["actions"][:, 0]).long(), th.as_tensor(kept["returns"][:, 0])
    ids = th.eye(2)

    def values(t: int) -> th.Tensor:
        """Return the critic's values of all actions of both agents at a step, ``[2, 3]``."""
        other = th.nn.functional.one_hot(actions[t].flip(0), 3).float()
        return before.critic(th.cat([obs["state"][t].expand(2, -1), obs["obs"][t], ids, other], dim=1))

    for t in reversed(range(6)):
        descend(before.critic, ((values(t).gather(1, actions[t][:, None])[:, 0] - returns[t]) ** 2).mean())
    gain, n_in_play = th.zeros(()), 0
    for t in range(6):
        logits = before.actor(th.cat([obs["obs"][t], ids], dim=1)).masked_fill(obs["mask"][t] == 0, -1e9)
        chances, q = logits.softmax(dim=1), values(t).detach()
        for agent in (0, 1):
            if agent == 1 and t % 3 == 2:
                # "b" has gone after two steps
                continue
            n_in_play += 1
            advantage = q[agent, actions[t, agent]] - (chances[agent] * q[agent]).sum().detach()
            entropy = -(chances[agent] * chances[agent].clamp(min=1e-30).log()).sum()
            gain = gain + advantage * chances[agent, actions[t, agent]].log() + 0.3 * entropy
    descend(before.actor, -gain / n_in_play)
    assert close(model.policy.critic, before.critic) and close(model.policy.actor, before.actor)
    moved = [(a - b).abs().max().item() for a, b in zip(first, model.policy.actor.parameters(), strict=True)]
    assert np.isfinite(moved).all() and min(moved) > 3e-6


def test_maddpg():
    tau = 0.25
    model = MADDPG(
        *("MaddpgPolicy", joint_env(n_envs=1, truncates=True)),
        **{"learning_starts": 100, "batch_size": 6, "tau": tau, "seed": 0, "learning_rate": RATE, "max_grad_norm": 1e9},
        policy_kwargs={**SGD, "net_arch": [8]},
        device="cpu",
    )
    model.learn(30)
    policy = model.policy
    with th.no_grad():
        for target in (policy.actor_targets, policy.critic_targets):
            for parameter in target.parameters():
                parameter.add_(0.3 * th.randn_like(parameter))
    buffer: Any = model.replay_buffer
    samples = buffer.sample(6)
    buffer.sample = lambda *args, **kwargs: samples
    before = deepcopy(policy)
    th.manual_seed(3)
    model.train(1, 6)
    th.manual_seed(3)
    # The targets: of the next state, by the target actors and critics
    with th.no_grad():
        after = samples.next_observations
        logits = before.actor_targets(after["obs"].float().transpose(0, 1)).transpose(0, 1)
        chosen = before.act(logits.masked_fill(after["mask"] == 0, -th.inf))
        joint = th.cat([after["state"], chosen.flatten(1)], dim=1)
        ahead = th.stack([before.critic_targets(joint.expand(2, -1, -1))[agent, :, 0] for agent in (0, 1)], dim=1)
        targets = samples.rewards + 0.95 * (1 - samples.ends) * ahead
    taken = th.nn.functional.one_hot(samples.actions.long(), before.width).float()
    joint = th.cat([samples.observations["state"], taken.flatten(1)], dim=1)
    errors = (before.critics(joint.expand(2, -1, -1))[..., 0].T - targets) ** 2
    descend(before.critics, errors.mean(dim=0).sum())
    assert close(policy.critics, before.critics)
    # The targets follow by a share
    for target, network, old in (
        (policy.critic_targets, policy.critics, before.critic_targets),
        (policy.actor_targets, policy.actors, before.actor_targets),
    ):
        for new, source, was in zip(target.parameters(), network.parameters(), old.parameters(), strict=True):
            assert th.allclose(new, (1 - tau) * was + tau * source, atol=1e-6)


def test_qtrans_values_are_trained_by_its_consistency():
    """The error of the joint value alone has no gradient in the agents' values."""
    model = ValueFactorisation("FactorisedPolicy", joint_env(n_envs=2), mixer="qtran", batch_size=2, buffer_size=20, seed=0)
    model.learn(12)
    batch = model.replay_buffer.batch(model.replay_buffer.episodes[:2])
    last = model.policy.net.agents.nets[0].last
    model.policy.net.mixer.opt_coef = model.policy.net.mixer.nopt_coef = 0.0
    model._update(batch)
    assert last.weight.grad is None or not last.weight.grad.any()
    model.policy.net.mixer.opt_coef = 1.0
    model._update(batch)
    assert last.weight.grad is not None and last.weight.grad.any()


def test_rodes_losses_are_errors_of_its_targets(monkeypatch):
    model = with_roles(env=joint_env(n_envs=2, length=5), role_start=1, batch_size=2, learning_rate=0.0)
    model.learn(20)
    batch = model.replay_buffer.batch(model.replay_buffer.episodes[:2])
    at = model._learn_values(batch)
    targets = model.role_targets(batch)
    # One role's return more: those of roles count at the steps 0, 2 and 4, at which roles are chosen, and of actions at all
    moved = (targets[0].clone(), targets[1].clone())
    moved[0][0, 1] += 100.0
    monkeypatch.setattr(model, "role_targets", lambda _: moved)
    assert model._learn_values(batch)["role_loss"] == pytest.approx(at["role_loss"], rel=1e-5)
    moved[0][:], moved[1][:] = targets[0] + 10.0, targets[1] + 10.0
    after = model._learn_values(batch)
    monkeypatch.setattr(model, "role_targets", lambda _: (targets[0] - 10.0, targets[1] - 10.0))
    other = model._learn_values(batch)
    for name in ("role_loss", "action_loss"):
        # (e - 10)² + (e + 10)² = 2 e² + 200
        assert (after[name] + other[name]) / 2 == pytest.approx(at[name] + 100.0, rel=1e-4)


def test_iql_tosses_a_coin_for_each_copy_in_training():
    from sb3_belief.baselines import IQL
    from tests.baselines.test_iac import make_env

    model = IQL("MlpPolicy", make_env(n_envs=40), learning_starts=0, seed=0, device="cpu", exploration_initial_eps=0.5)
    model.exploration_rate = 0.5
    model.learn(40)
    model.exploration_rate = 0.5
    greedy = model.predict(model._last_obs, deterministic=True)[0]
    shares = [np.mean(model._sample_action(0, n_envs=40)[0] == greedy) for _ in range(30)]
    # One coin for all copies would make them all greedy, or a fifth of them
    assert 0.4 < np.mean(shares) < 0.9 and np.std(shares) < 0.15
