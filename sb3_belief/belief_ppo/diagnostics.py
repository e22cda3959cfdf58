"""How good a belief is, measured on steps that it has not been trained on yet."""

import math

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_belief.belief import ActionLayout, kl_divergence
from sb3_belief.belief_ppo.buffers import BeliefBufferMixin, BeliefMinibatch, attach
from sb3_belief.belief_ppo.extractor import BeliefExtractor, BeliefFusion, rollout_rows
from sb3_belief.belief_ppo.policies import BeliefPolicyMixin

# Enough for two significant digits, at a small part of an update's time
PROBE_ROWS = 256


@th.no_grad()
def measure_belief(policy: BeliefPolicyMixin, buffer: BeliefBufferMixin) -> dict[str, float]:
    """
    Measure the belief on steps that it has not been trained on yet.

    :param policy: A policy with a belief
    :param buffer: Its complete rollout, before the update that trains on it
    :return: By name, over up to 256 active steps spread evenly over the rollout:
        ``action_loss`` (eq. 7, or the cross-entropy in its place) and ``kl``, as they enter eq. 8 before their weights;
        ``accuracy`` of the most likely action of each visible other, and ``base_rate``, that of always naming each other's
        most frequent action (for one-hot actions: Discrete, MultiDiscrete);
        ``history_gain``, how much the action loss rises when the history's actions are shuffled across its rows (0 while
        the history is empty, and for a belief without one);
        ``history_gain_rare``, the same over those visible others alone who did something else than what each does most often,
        where actions are discrete (issue 19). Where a type shows in a few steps only, the mean over all of them hides it;
        ``attention_entropy``, of the attention weights, in nats, at most log N_h;
        ``fusion_ratio``, weight of the belief where policy and value fuse it, in [0, 1] (Fig. 5e);
        ``visible_fraction``, share of the others that are visible;
        ``first_log_ratio``, largest ``|log ratio|`` of the policies that acted and that is trained: 0 but for rounding.
        Measures of parts that a belief or its policy does not have (a prediction, a sampled latent, attention, our fusion) are
        left out
    """
    steps = buffer.active_steps()
    step = buffer.rows_of(steps[np.linspace(0, len(steps) - 1, min(PROBE_ROWS, len(steps))).astype(int)])
    minibatch = buffer.belief_minibatch(step)
    observations = rollout_rows(buffer.observations, step, policy.device)
    flat = policy.flat_observations(observations)

    belief, variant = policy.belief, policy.options.variant
    assert belief is not None and variant is not None
    assert isinstance(policy.features_extractor, BeliefExtractor)
    measured = dict(
        visible_fraction=float(minibatch.others_visible.float().mean()),
        first_log_ratio=_first_log_ratio(policy, buffer, step, observations, minibatch),
        history_gain=0.0,
    )
    if isinstance(policy.mlp_extractor, BeliefFusion):
        measured["fusion_ratio"] = policy.mlp_extractor.belief_share()
    # The rollout has encoded the history already
    output = policy.features_extractor.judged(flat, minibatch)
    if variant.samples:
        measured["kl"] = float(kl_divergence(output.mean, output.log_std))
    if variant.attends:
        measured["attention_entropy"] = float(-(output.weights * output.weights.clamp(min=1e-12).log()).sum(dim=1).mean())
    if output.prediction is None:
        return measured
    measured["action_loss"] = float(policy.action_error(output.prediction, minibatch))
    if policy.layout.blocks:
        measured["history_gain_rare"] = 0.0
    history = policy.features_extractor.attended()
    if history is not None and history.valid.any():
        with_shuffled = history._replace(actions=_shuffled(history.actions, history.valid))
        shuffled = policy.features_extractor.judged(flat, minibatch, with_shuffled)
        assert shuffled.prediction is not None
        measured["history_gain"] = float(policy.action_error(shuffled.prediction, minibatch)) - measured["action_loss"]
        if policy.layout.blocks:
            rare = minibatch._replace(others_visible=_did_the_rare(minibatch, policy.layout))
            errors = [float(policy.action_error(each, rare)) for each in (shuffled.prediction, output.prediction)]
            measured["history_gain_rare"] = errors[0] - errors[1]
    accuracy, base_rate = _accuracies(output.prediction, minibatch, policy.layout)
    if not math.isnan(accuracy):
        measured["accuracy"], measured["base_rate"] = accuracy, base_rate
    return measured


def _shuffled(actions: th.Tensor, valid: th.Tensor) -> th.Tensor:
    """Return the valid rows in an arbitrary but fixed order. Drawing one would advance the generator of the update."""
    rows = valid.nonzero().flatten()
    order = th.as_tensor(np.random.default_rng(0).permutation(len(rows)), device=actions.device)
    result = actions.clone()
    result[rows] = actions[rows[order]]
    return result


def _first_log_ratio(
    policy: BeliefPolicyMixin,
    buffer: BeliefBufferMixin,
    step: tuple[np.ndarray, ...],
    observations: th.Tensor | dict[str, th.Tensor],
    minibatch: BeliefMinibatch,
) -> float:
    # As SB3's _get_samples: MultiBinary's are kept as int8, for which torch has no likelihood
    actions = buffer.to_torch(buffer.actions[step].astype(np.float32, copy=False))
    if isinstance(policy.action_space, spaces.Discrete):
        actions = actions.long().flatten()
    masks = {}
    # sb3-contrib's, which is not imported for the others
    if hasattr(buffer, "action_masks"):
        masks["action_masks"] = buffer.to_torch(buffer.action_masks[step])
    _, log_prob, _ = policy.evaluate_actions(attach(observations, minibatch), actions, **masks)
    return float((log_prob - buffer.to_torch(buffer.log_probs[step]).flatten()).abs().max())


def _did_the_rare(minibatch: BeliefMinibatch, layout: ActionLayout) -> th.Tensor:
    """Return who was visible and did something else than what each does most often, bool ``[B, n_others]``."""
    rare = th.zeros_like(minibatch.others_visible)
    for owner, start, width in layout.blocks:
        visible = minibatch.others_visible[:, owner]
        taken = minibatch.others_actions[:, start : start + width].argmax(dim=1)
        rare[:, owner] |= visible & (taken != taken[visible].bincount(minlength=width).argmax())
    return rare


def _accuracies(prediction: th.Tensor, minibatch: BeliefMinibatch, layout: ActionLayout) -> tuple[float, float]:
    """Return accuracy and base rate over all visible discrete actions; NaN where there are none."""
    right = most_frequent = total = 0
    for owner, start, width in layout.blocks:
        visible = minibatch.others_visible[:, owner]
        taken = minibatch.others_actions[visible, start : start + width].argmax(dim=1)
        right += int((prediction[visible, start : start + width].argmax(dim=1) == taken).sum())
        most_frequent += int(taken.bincount(minlength=width).max())
        total += len(taken)
    return (right / total, most_frequent / total) if total else (math.nan, math.nan)
