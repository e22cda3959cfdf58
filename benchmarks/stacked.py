"""
What would it bring to update agents of equal shape with one set of stacked kernels? The experiment behind docs/performance.md.

    python -m benchmarks.stacked

Gradient steps of PPO with a belief for several agents: all those of one agent and then those of the next, as a team does them;
all agents' at once, with their weights stacked to ``[agents, out, in]``; and in lockstep, where only the passes forward and
backward are stacked, and each agent has its own loss, clipping and optimiser, as SB3 would have it. The row of a single agent
shows what is saved by leaving out what SB3's policies do besides.

It prints milliseconds of a step of all agents, medians of rounds in turn, how many times as long one by one takes (quartiles
in brackets), and the largest difference of any weight after the first step. On the CPU these are CPU seconds of one thread,
on a GPU, where there is one, seconds on the wall.
"""

import argparse
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import torch as th
import torch.nn.functional as F
from gymnasium import spaces
from torch import nn

from benchmarks.measure import Loop, Spread, alternate, ratio, speeds, spread
from sb3_belief.belief import History, kl_divergence
from sb3_belief.belief.attention import attend
from sb3_belief.belief.network import LOG_STD_RANGE
from sb3_belief.belief_ppo import BeliefActorCriticPolicy, BeliefMinibatch

OBSERVATION, N_ACTIONS, N_OTHERS, HISTORY, KEPT, LATENT = 18, 5, 2, 800, 40, 64
CLIP, VALUE_COEF, MAX_NORM, LEARNING_RATE = 0.2, 0.5, 0.5, 3e-4
# Agents and rows of a minibatch: one, which shows what is saved without stacking; those of simple_spread; and many
SIZES = ((1, 256), (3, 256), (8, 256), (8, 3200))


class Batch(NamedTuple):
    """What one agent's gradient step is made of."""

    observations: th.Tensor
    actions: th.Tensor
    old_log_prob: th.Tensor
    advantages: th.Tensor
    returns: th.Tensor
    belief: BeliefMinibatch


def make_policy(device: str) -> BeliefActorCriticPolicy:
    """
    :param device: of the policy
    :return: one with a full history
    """
    others = {f"other_{i}": spaces.Discrete(N_ACTIONS) for i in range(N_OTHERS)}
    space = spaces.Box(-10.0, 10.0, (OBSERVATION,))
    policy = BeliefActorCriticPolicy(space, spaces.Discrete(N_ACTIONS), lambda _: LEARNING_RATE, others_action_spaces=others)
    policy.to(device)
    seen = F.one_hot(th.randint(N_ACTIONS, (HISTORY, N_OTHERS)), N_ACTIONS).float().flatten(1)
    policy.remember(th.randn(HISTORY, OBSERVATION).numpy(), seen.numpy())
    # With the weights where they are
    policy.optimizer = th.optim.Adam(policy.parameters(), LEARNING_RATE, eps=1e-5, fused=True)
    return policy


def make_batch(n_rows: int, device: str) -> Batch:
    """
    :param n_rows: of the minibatch
    :param device: of the tensors
    :return: a minibatch of random numbers
    """
    belief = BeliefMinibatch(
        noise=th.randn(n_rows, LATENT).to(device),
        kept=th.rand(n_rows, HISTORY).topk(KEPT, dim=1).indices.sort(dim=1).values.int().to(device),
        others_actions=F.one_hot(th.randint(N_ACTIONS, (n_rows, N_OTHERS)), N_ACTIONS).float().flatten(1).to(device),
        others_visible=(th.rand(n_rows, N_OTHERS) < 0.5).to(device),
    )
    actions = th.randint(N_ACTIONS, (n_rows,)).to(device)
    old_log_prob = th.full((n_rows,), 1 / N_ACTIONS).log().to(device)
    advantages, returns = th.randn(2, n_rows).to(device)
    return Batch(th.randn(n_rows, OBSERVATION).to(device), actions, old_log_prob, advantages, returns, belief)


def ppo_loss(log_prob: th.Tensor, values: th.Tensor, batch: Batch) -> th.Tensor:
    """
    :param log_prob: of the actions, ``[..., B]``
    :param values: of the observations, ``[..., B]``
    :param batch: of one agent, or of all, stacked
    :return: PPO's loss, the mean over the last dimension
    """
    ratio = (log_prob - batch.old_log_prob).exp()
    clipped = ratio.clamp(1 - CLIP, 1 + CLIP)
    gain = th.min(batch.advantages * ratio, batch.advantages * clipped)
    return (VALUE_COEF * (values - batch.returns).square() - gain).mean(dim=-1)


class OneByOne:
    """
    :param policies: of the agents
    :param batches: theirs
    """

    def __init__(self, policies: list[BeliefActorCriticPolicy], batches: list[Batch]) -> None:
        self.policies, self.batches = policies, batches

    def steps(self, n: int) -> None:
        """
        :param n: gradient steps of each agent, one agent after the other: what it works on stays in the processor's caches
        """
        for policy, batch in zip(self.policies, self.batches, strict=True):
            for _ in range(n):
                policy.stage(batch.belief)
                values, log_prob, _ = policy.evaluate_actions(batch.observations, batch.actions)
                loss = ppo_loss(log_prob, values.flatten(), batch)
                policy.optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(policy.parameters(), MAX_NORM)
                policy.optimizer.step()

    def weights(self) -> dict[str, th.Tensor]:
        """
        :return: all agents' weights by name, ``[agents, ...]``
        """
        named = [dict(policy.named_parameters()) for policy in self.policies]
        return {name: th.stack([weights[name].detach() for weights in named]) for name in named[0]}


class StackedPasses(ABC):
    """
    Weights, histories and minibatches of all agents, stacked, and the passes forward of all at once.

    :param policies: of the agents
    :param batches: theirs
    """

    def __init__(self, policies: list[BeliefActorCriticPolicy], batches: list[Batch]) -> None:
        stacked = OneByOne(policies, batches).weights()
        self._weights = {name: weights.clone().requires_grad_() for name, weights in stacked.items()}
        self._action_coef, self._kl_coef = policies[0].action_coef, policies[0].kl_coef
        histories = [policy.history for policy in policies]
        self._history = History(*(th.stack(parts) for parts in zip(*(h for h in histories if h is not None), strict=True)))
        belief = BeliefMinibatch(*map(th.stack, zip(*(batch.belief for batch in batches), strict=True)))
        tensors = [batch[:-1] for batch in batches]
        observations, actions, old_log_prob, advantages, returns = map(th.stack, zip(*tensors, strict=True))
        self._batch = Batch(observations, actions, old_log_prob, advantages, returns, belief)

    def _linear(self, name: str, inputs: th.Tensor) -> th.Tensor:
        weight, bias = self._weights[f"{name}.weight"].mT, self._weights.get(f"{name}.bias")
        return inputs @ weight if bias is None else th.baddbmm(bias[:, None], inputs, weight)

    def _believe(self) -> tuple[th.Tensor, th.Tensor]:
        """Latents ``[agents, B, z]``, and the belief's loss, summed over the agents."""
        name = "features_extractor.belief"

        def embed(observations: th.Tensor) -> th.Tensor:
            hidden = self._linear(f"{name}.observation_embedding.0", observations).relu()
            return self._linear(f"{name}.observation_embedding.2", hidden)

        embedding = embed(self._batch.observations)
        states = embed(self._history.observations) + self._linear(f"{name}.action_embedding", self._history.actions)
        queries = self._linear(f"{name}.query", embedding) @ (self._weights[f"{name}.key.weight"] / states.shape[2] ** 0.5)
        means, _ = attend(queries, states, states, self._batch.belief.kept)
        embedding = embedding + self._linear(f"{name}.value", means)
        mean, log_std = self._linear(f"{name}.encoder", embedding).chunk(2, dim=2)
        log_std = F.hardtanh(log_std, *LOG_STD_RANGE)
        latent = mean + log_std.exp() * self._batch.belief.noise
        errors = (self._batch.belief.others_actions - self._linear(f"{name}.decoder", latent)).square()
        visible = self._batch.belief.others_visible
        n_visible = visible.sum(dim=(1, 2)).clamp(min=1)
        seen = (errors.unflatten(2, (-1, N_ACTIONS)).sum(dim=3) * visible).sum(dim=(1, 2)) / n_visible
        divergences = sum(kl_divergence(*own) for own in zip(mean, log_std, strict=True))
        return latent, self._action_coef * seen.sum() + self._kl_coef * divergences

    def passes(self) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """
        :return: values and log probabilities of the actions, each ``[agents, B]``, and the beliefs' loss, summed over agents
        """
        latent, belief_loss = self._believe()
        codes = []
        for head, fusion in (("policy_net", "fuse_pi"), ("value_net", "fuse_vf")):
            code = self._linear(f"mlp_extractor.base.{head}.0", self._batch.observations).tanh()
            code = self._linear(f"mlp_extractor.base.{head}.2", code).tanh()
            codes.append(self._linear(f"mlp_extractor.{fusion}", th.cat([code, latent], dim=2)).relu())
        log_probs = self._linear("action_net", codes[0]).log_softmax(dim=2)
        log_prob = log_probs.gather(2, self._batch.actions[:, :, None]).squeeze(2)
        return self._linear("value_net", codes[1]).squeeze(2), log_prob, belief_loss

    @abstractmethod
    def _step(self) -> None:
        """One gradient step of each agent."""

    def steps(self, n: int) -> None:
        """
        :param n: gradient steps of each agent
        """
        for _ in range(n):
            self._step()

    def weights(self) -> dict[str, th.Tensor]:
        """
        :return: all agents' weights by name, ``[agents, ...]``
        """
        return {name: weights.detach() for name, weights in self._weights.items()}


class Stacked(StackedPasses):
    """
    All of the step for all agents at once: loss, clipping and optimiser, too.

    :param policies: of the agents
    :param batches: theirs
    """

    def __init__(self, policies: list[BeliefActorCriticPolicy], batches: list[Batch]) -> None:
        super().__init__(policies, batches)
        self._optimizer = th.optim.Adam(self._weights.values(), LEARNING_RATE, eps=1e-5, fused=True)

    def _step(self) -> None:
        values, log_prob, belief_loss = self.passes()
        self._optimizer.zero_grad()
        (ppo_loss(log_prob, values, self._batch).sum() + belief_loss).backward()
        self._clip()
        self._optimizer.step()

    def _clip(self) -> None:
        """The norm of each agent's gradient, at most ``MAX_NORM``."""
        gradients = [weights.grad for weights in self._weights.values() if weights.grad is not None]
        norms = th.stack([gradient.flatten(1).norm(dim=1) for gradient in gradients]).norm(dim=0)
        factors = (MAX_NORM / (norms + 1e-6)).clamp(max=1)
        for gradient in gradients:
            gradient.mul_(factors.view(-1, *[1] * (gradient.dim() - 1)))


class InLockstep(StackedPasses):
    """
    Only the passes forward and backward for all agents at once. Each agent has a loss, a clipping and an optimiser of its own,
    as its own ``train()`` would have them.

    :param policies: of the agents
    :param batches: theirs
    """

    def __init__(self, policies: list[BeliefActorCriticPolicy], batches: list[Batch]) -> None:
        super().__init__(policies, batches)
        self._batches = batches
        # Slices of the stacked weights, in the same memory
        self._own = [[w.detach()[i].requires_grad_() for w in self._weights.values()] for i in range(len(policies))]
        self._optimizers = [th.optim.Adam(own, LEARNING_RATE, eps=1e-5, fused=True) for own in self._own]

    def _step(self) -> None:
        values, log_prob, belief_loss = self.passes()
        gradients = []
        for i, batch in enumerate(self._batches):
            own = values.detach()[i].requires_grad_(), log_prob.detach()[i].requires_grad_()
            ppo_loss(own[1], own[0], batch).backward()
            gradients.append([part.grad for part in own])
        for weights in self._weights.values():
            weights.grad = None
        upstream = [th.stack(parts) for parts in zip(*gradients, strict=True)]
        th.autograd.backward([values, log_prob, belief_loss], [*upstream, th.ones_like(belief_loss)])
        for i, (own_weights, optimizer) in enumerate(zip(self._own, self._optimizers, strict=True)):
            for slice_, weights in zip(own_weights, self._weights.values(), strict=True):
                assert weights.grad is not None
                slice_.grad = weights.grad[i]
            nn.utils.clip_grad_norm_(own_weights, MAX_NORM)
            optimizer.step()


WAYS: dict[str, type[OneByOne] | type[Stacked] | type[InLockstep]] = {
    "one by one": OneByOne,
    "lockstep": InLockstep,
    "stacked": Stacked,
}


class Comparison(NamedTuple):
    """
    :param seconds: of a step of all agents, by way
    :param gains: time one by one over that, by way
    :param difference: the largest of any weight to those one by one, after the first step
    """

    seconds: dict[str, Spread]
    gains: dict[str, Spread]
    difference: float


def compare(n_agents: int, n_rows: int, rounds: int, device: str = "cpu") -> Comparison:
    """
    :param n_agents: each with a belief about two others
    :param n_rows: of a minibatch
    :param rounds: measurements of each way
    :param device: where
    :return: what was found
    """
    th.manual_seed(0)
    policies = [make_policy(device) for _ in range(n_agents)]
    batches = [make_batch(n_rows, device) for _ in range(n_agents)]
    # Those that copy the weights before the one that trains the policies themselves
    ways = {name: WAYS[name](policies, batches) for name in reversed(WAYS)}
    for way in ways.values():
        way.steps(1)
    expected = ways["one by one"].weights()
    differences = [(way.weights()[name] - weights).abs().max() for way in ways.values() for name, weights in expected.items()]
    samples = alternate({name: _loop(way.steps, device) for name, way in ways.items()}, rounds)
    clock = "cpu" if device == "cpu" else "wall"
    return Comparison(
        {name: spread([1 / speed for speed in speeds(samples[name], clock)]) for name in WAYS},
        {name: ratio(samples[name], samples["one by one"], clock) for name in WAYS},
        float(max(differences)),
    )


def _loop(steps: Callable[[int], None], device: str, n: int = 8) -> Loop:
    def loop() -> int:
        steps(n)
        if device != "cpu":
            th.cuda.synchronize()
        return n

    return loop


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=15)
    args = parser.parse_args()
    th.set_num_threads(1)
    columns = "".join(f"{name:>30}" for name in WAYS)
    print(f"{'device':>6} {'agents':>6} {'rows':>6}{columns}   difference")
    for device in ("cpu", "cuda"):
        if device == "cuda" and not th.cuda.is_available():
            print("  cuda skipped: torch finds no GPU")
            continue
        for n_agents, n_rows in SIZES:
            seconds, gains, difference = compare(n_agents, n_rows, args.rounds, device)
            texts = [f"{1000 * seconds[name].median:.1f} ms, {_text(gains[name])}" for name in WAYS]
            print(
                f"{device:>6} {n_agents:>6} {n_rows:>6,}" + "".join(f"{text:>30}" for text in texts) + f"   {difference:.0e}"
            )


def _text(gain: Spread) -> str:
    return f"{gain.median:.2f} [{gain.low:.2f}, {gain.high:.2f}]"


if __name__ == "__main__":
    main()
