"""
Passes of several policies that act at the same time.

Small networks take more time for calls than for products, so one pass is made for all policies with equal networks, from
observations to latent codes. The rest is each policy's own ``forward``, in its own random stream. What comes of it is the
same, bit for bit: whether it is, which hangs on the shapes and on the libraries behind PyTorch, is tried out once for each
shape, and where it is not, each policy makes its own passes.
"""

from collections import defaultdict
from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

import torch as th

from sb3_belief.belief import BeliefOutput
from sb3_belief.belief_ppo.extractor import BeliefExtractor, flat_observations
from sb3_belief.common.tensor_version import TensorVersions
from sb3_belief.team.batched_forward.networks import StackedNetworks, signature


class Latents(NamedTuple):
    """
    :param policy: what the actions' distribution is computed from, ``[B, ...]``
    :param value: what the values are computed from, ``[B, ...]``
    :param belief: behind both; None for a policy without
    """

    policy: th.Tensor
    value: th.Tensor
    belief: BeliefOutput | None


# A number for each signature, since they are compared at every step
_numbers: dict[Hashable, int] = {}
# Whether so many parts of a kind bring the same when they are made together
_agrees: dict[Hashable, bool] = {}


class ForwardRequest:
    """
    A policy's part in passes that are made together: its inputs before, and what follows from the codes afterwards. Good for
    a rollout, in which its networks remain the same.

    :param policy: the policy
    """

    codes: Latents | None
    _flat: th.Tensor
    _noise: th.Tensor | None

    def __init__(self, policy: Any):
        self.policy = policy
        found = signature(policy)
        #: Equal for policies of equal networks; None for one that can only act by itself
        self.signature = None if found is None else _numbers.setdefault(found, len(_numbers))
        extractor = getattr(policy, "features_extractor", None)
        self._extractor = extractor if isinstance(extractor, BeliefExtractor) else None
        self._counted, self._n_rows = TensorVersions(), 0
        # With whom it is made together, if it is the first of them
        self._others: list[ForwardRequest] | None = None
        self._networks: StackedNetworks | None = None

    def can_take(self, *args: Any, **kwargs: Any) -> bool:
        """
        :param args: of ``forward``
        :param kwargs: of ``forward``
        :return: whether such a pass can be made together with others
        """
        is_usual = len(args) == 1 and isinstance(args[0], th.Tensor) and kwargs.keys() <= {"action_masks"}
        return self.signature is not None and is_usual and not th.is_grad_enabled()

    def prepare(self, obs: th.Tensor) -> None:
        """
        :param obs: as ``forward`` takes it; what is to be drawn for the belief about it is drawn now
        """
        self._flat = flat_observations(self.policy, obs)
        self._noise = None if self._extractor is None else self._extractor.draw_noise(self._flat)
        self.codes = None

    @property
    def kind(self) -> Hashable:
        """Equal for those whose passes can be made together."""
        history = None if self._extractor is None else self._extractor.history
        if history is not None and self._counted.changed([history.valid]):
            self._n_rows = int(history.valid.sum())
        return self.signature, self._flat.shape, self._n_rows

    def _own_codes(self, flat: th.Tensor, noise: th.Tensor | None) -> Latents:
        belief: BeliefOutput | None = None
        features: Any = flat
        if self._extractor is not None:
            belief = self._extractor.infer(flat, noise, predict=False)
            features = self._extractor.beside(flat, belief)
        policy, value = self.policy.mlp_extractor(features)
        return Latents(policy, value, belief)

    def make_alone(self) -> None:
        """Make a pass of its own."""
        self.codes = self._own_codes(self._flat, self._noise)

    def make_with(self, others: list["ForwardRequest"], kind: Hashable) -> bool:
        """
        :param others: of the same kind; all are given their codes
        :param kind: theirs
        :return: whether they were: not if those of their own passes would be others
        """
        group, shape = [self, *others], (1 + len(others), kind)
        if shape in _agrees and not _agrees[shape]:
            return False
        if others != self._others:
            self._others, self._networks = others, StackedNetworks([part.policy for part in group])
        assert self._networks is not None
        if shape not in _agrees:
            _agrees[shape] = self._try_out(group, self._networks)
            if not _agrees[shape]:
                return False
        noise = None if self._noise is None else th.stack([part._noise for part in group])  # type: ignore[misc]
        made = self._networks(th.stack([part._flat for part in group]), noise)
        for i, part in enumerate(group):
            part.codes = _of_agent(i, *made)
        return True

    def _try_out(self, group: list["ForwardRequest"], networks: StackedNetworks) -> bool:
        """Whether they bring the same on other observations, too, than the present ones, which may be all zero."""
        device = self._flat.device
        generator = th.Generator(device).manual_seed(0)
        flat = th.randn(len(group), *self._flat.shape, generator=generator, device=device)
        noise = None
        if self._noise is not None:
            noise = th.randn(len(group), *self._noise.shape, generator=generator, device=device)
        made = networks(flat, noise)
        own = [part._own_codes(flat[i], None if noise is None else noise[i]) for i, part in enumerate(group)]
        return all(_equal(_of_agent(i, *made), codes) for i, codes in enumerate(own))

    def finish(self, *args: Any, **kwargs: Any) -> Any:
        """
        :param args: of ``forward``
        :param kwargs: of ``forward``
        :return: what it returns
        """
        assert self.codes is not None
        codes, place = self.codes, vars(self.policy)
        if self._extractor is not None:
            self._extractor.passing.output, self._extractor.passing.noise = codes.belief, self._noise
        # SB3's own method asks for these two, one after the other
        place["extract_features"] = place["mlp_extractor"] = lambda _: (codes.policy, codes.value)
        try:
            return type(self.policy).forward(self.policy, *args, **kwargs)
        finally:
            del place["extract_features"], place["mlp_extractor"]


def _of_agent(i: int, policy: th.Tensor, value: th.Tensor, belief: BeliefOutput | None) -> Latents:
    own = None if belief is None else BeliefOutput(*(None if each is None else each[i] for each in belief))  # type: ignore
    return Latents(policy[i], value[i], own)


def _equal(a: Latents, b: Latents) -> bool:
    if a.policy.device.type != "cpu":
        # There nothing is promised to the bit
        return th.allclose(a.policy, b.policy, atol=1e-5) and th.allclose(a.value, b.value, atol=1e-5)
    same_rows = a.belief is None or b.belief is None or th.equal(a.belief.kept, b.belief.kept)
    return same_rows and th.equal(a.policy, b.policy) and th.equal(a.value, b.value)


class ForwardBatcher:
    """Makes the passes of those who have prepared them."""

    def __init__(self) -> None:
        self._waiting: list[ForwardRequest] = []

    def join(self, part: ForwardRequest) -> None:
        """
        :param part: prepared, of a policy that then waits for others
        """
        self._waiting.append(part)

    def go_on(self, part: ForwardRequest) -> None:
        """
        :param part: of a policy that has waited; the first of them makes the passes of all
        """
        if part.codes is None:
            waiting, self._waiting = self._waiting, []
            make(waiting)


@th.no_grad()
def make(parts: Sequence[ForwardRequest]) -> None:
    """
    :param parts: prepared; they are given their codes
    """
    kinds: dict[Hashable, list[ForwardRequest]] = defaultdict(list)
    for part in parts:
        kinds[part.kind].append(part)
    for kind, (first, *others) in kinds.items():
        if not (others and first.make_with(others, kind)):
            for part in (first, *others):
                part.make_alone()
