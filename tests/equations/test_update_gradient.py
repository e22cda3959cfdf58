"""The gradient of a real update is that of the sum of eq. 8, written out here for all variants and switches."""

from typing import Any

import pytest
import torch as th
from torch.nn import functional as F

from sb3_belief.belief.memory import followed_by, valid_rows
from sb3_belief.belief_ppo import MaskableBeliefPPO
from sb3_belief.belief_ppo.policies import add_loss
from tests.belief_ppo.helpers import ALGORITHMS, ROLLOUT, VARIANTS, Watch, make_model

ALPHA, BETA = 0.5, 0.05


def ppo_loss(model, output) -> th.Tensor:
    """PPO's loss over the whole rollout, through policy and value networks written out layer by layer."""
    policy, buffer = model.policy, model.rollout_buffer

    def column(name: str) -> th.Tensor:
        return th.as_tensor(getattr(buffer, name).reshape(ROLLOUT))

    observations = th.as_tensor(buffer.observations.reshape(ROLLOUT, -1))
    latent = output.latent if model.policy_latent == "sample" else output.mean
    if model.belief == "adaptive":
        # It also gives policy and value what it expects of both others
        assert model.policy.action_loss == "cross_entropy" and output.prediction is not None
        expected = [output.prediction[:, start:stop].softmax(dim=1) for start, stop in ((0, 3), (3, 7))]
        latent = th.cat([output.mean, *expected], dim=1)
    latent = latent.detach() if model.detach_belief else latent
    fusion = policy.mlp_extractor
    codes = [
        th.relu(fuse(th.cat([base(observations), latent], dim=1)))
        for base, fuse in ((fusion.base.policy_net, fusion.fuse_pi), (fusion.base.value_net, fusion.fuse_vf))
    ]
    logits, values = policy.action_net(codes[0]), policy.value_net(codes[1]).flatten()
    possible = th.ones(ROLLOUT, 3, dtype=th.bool)
    if isinstance(model, MaskableBeliefPPO):
        possible = th.as_tensor(buffer.action_masks.reshape(ROLLOUT, 3)).bool()
        assert not possible.all()
    log_probs = logits.masked_fill(~possible, -1e8).log_softmax(dim=1)
    entropy = -(log_probs.exp() * log_probs).masked_fill(~possible, 0).sum(dim=1).mean()
    ratio = (log_probs.gather(1, column("actions").long().unsqueeze(1)).flatten() - column("log_probs")).exp()
    advantages = column("advantages")
    surrogate = th.min(advantages * ratio, advantages * ratio.clamp(0.8, 1.2)).mean()
    return -surrogate - 0.01 * entropy + 0.7 * F.mse_loss(column("returns"), values)


def belief_loss(model, output, part) -> th.Tensor | float:
    """The two further terms of eq. 8, among a first other with three actions and a second with four."""
    if output.prediction is None:
        return 0.0
    errors = th.tensor(0.0)
    for other, (start, stop) in enumerate([(0, 3), (3, 7)]):
        predicted, taken = output.prediction[:, start:stop], part.others_actions[:, start:stop]
        if model.policy.action_loss == "mse":
            error = (taken - predicted).pow(2).sum(dim=1)
        else:
            error = F.cross_entropy(predicted, taken.argmax(dim=1), reduction="none")
        errors = errors + error[part.others_visible[:, other]].sum()
    loss = ALPHA * errors / part.others_visible.sum()
    if model.belief in ("dynamic", "variational"):
        believed = th.distributions.Normal(output.mean, output.log_std.exp())
        prior = th.distributions.Normal(th.zeros_like(output.mean), th.ones_like(output.mean))
        loss = loss + BETA * th.distributions.kl_divergence(believed, prior).sum(dim=1).mean()
    return loss


SWITCHES: list[dict[str, Any]] = [
    *(dict(belief=variant) for variant in VARIANTS if variant != "adaptive"),
    *(dict(belief=variant, action_loss="cross_entropy") for variant in ("dynamic", "static")),
    # What is replayed would add to the sum (test_adaptive)
    dict(belief="adaptive", action_loss="cross_entropy", belief_replay=0),
    dict(belief="adaptive", action_loss="cross_entropy", belief_replay=0, detach_belief=True, history_dropout=0.3),
    dict(policy_latent="mean"),
    dict(detach_belief=True),
    dict(belief="variational", policy_latent="mean", detach_belief=True, action_loss="cross_entropy"),
    dict(similarity="observation"),
]


@pytest.mark.parametrize("switches", SWITCHES, ids=lambda switches: "-".join(map(str, switches.values())))
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_gradient_equals_that_of_the_explicit_sum(algorithm, switches):
    whole: dict[str, Any] = dict(n_epochs=1, batch_size=ROLLOUT, max_grad_norm=1e9, normalize_advantage=False)
    weights: dict[str, Any] = dict(vf_coef=0.7, ent_coef=0.01, action_coef=ALPHA, kl_coef=BETA)
    model = make_model(algorithm=algorithm, **whole, **weights, **switches)
    model.learn(ROLLOUT)  # so that there is a history
    explicit: dict[str, th.Tensor] = {}
    without_belief: dict[str, th.Tensor] = {}
    trained: dict[str, th.Tensor] = {}

    def look(model):
        part = model.rollout_buffer.belief_minibatch(slice(None))
        part = type(part)(*(field.reshape(ROLLOUT, -1) for field in part if field is not None))
        observations = th.as_tensor(model.rollout_buffer.observations.reshape(ROLLOUT, -1))
        if model.belief == "adaptive":
            # As the update has it
            table = followed_by(valid_rows(model.policy.history), model.remembered(0, model.n_steps))
            output = model.policy.features_extractor.judged(observations, part, table)
        else:
            output = model.policy.belief(observations, model.policy.history, part.noise, part.selected)
        ppo, further = ppo_loss(model, output), belief_loss(model, output, part)
        for gradients, loss in ((without_belief, ppo), (explicit, ppo + further)):
            named = dict(model.policy.named_parameters())
            found = th.autograd.grad(loss, list(named.values()), retain_graph=True, allow_unused=True)
            gradients.update({n: th.zeros_like(named[n]) if g is None else g for n, g in zip(named, found, strict=True)})

    step = model.policy.optimizer.step

    def watched(*args):
        trained.update({name: p.grad.clone() for name, p in model.policy.named_parameters()})
        return step(*args)

    model.policy.optimizer.step = watched
    model.learn(ROLLOUT, callback=Watch(look))
    assert trained.keys() == explicit.keys() and len(trained) > 15
    for name, gradient in explicit.items():
        th.testing.assert_close(trained[name], gradient, atol=1e-6, rtol=1e-5, msg=name)
        assert gradient.abs().max() > 0, name
    # The terms of the belief are large enough to be missed
    if model.belief != "wide":
        missing = max((trained[name] - gradient).abs().max() for name, gradient in without_belief.items())
        assert missing > 1e-3


@pytest.mark.parametrize("vf_coef", [0.0, 0.5])
def test_add_loss_has_weight_one_whatever_the_value_coefficient(vf_coef):
    a, b = th.tensor(2.0, requires_grad=True), th.tensor(3.0, requires_grad=True)
    values = add_loss(a * th.ones(4), b**2)
    (vf_coef * values.square().mean()).backward()
    assert values.tolist() == [2.0] * 4
    assert a.grad is not None and b.grad is not None
    assert a.grad.item() == pytest.approx(vf_coef * 4.0) and b.grad.item() == pytest.approx(6.0)
