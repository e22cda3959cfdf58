"""The beliefs that the paper compares (Table 2), and controls for what they add."""

from types import MappingProxyType
from typing import NamedTuple


class Variant(NamedTuple):
    """
    One kind of belief, described by the three parts of the method that it has.

    :param attends: Whether the belief is inferred from the agent's history too (eq. 3 and 4), or from its observation alone
    :param samples: Whether the belief is a distribution (eq. 5), which the KL divergence keeps near the prior, or a point
    :param predicts: Whether the belief is trained by predicting the others' actions (eq. 7)
    :param online: Whether the history includes the earlier steps of the rollout under way (docs/adaptive_belief.md)
    """

    attends: bool
    samples: bool
    predicts: bool
    online: bool = False


#: The values of ``belief`` other than ``"none"``. ``dynamic`` is the paper's method, ``static`` and ``variational`` are its
#: ablations ("static belief" and "belief with LVI"), and ``context`` is the fourth combination of attending and sampling.
#: ``wide`` has as many weights as ``dynamic`` but none of the three parts, so what it gains over no belief at all comes from
#: the larger network.
VARIANTS: MappingProxyType[str, Variant] = MappingProxyType(
    {
        "dynamic": Variant(attends=True, samples=True, predicts=True),
        "context": Variant(attends=True, samples=False, predicts=True),
        "variational": Variant(attends=False, samples=True, predicts=True),
        "static": Variant(attends=False, samples=False, predicts=True),
        "wide": Variant(attends=False, samples=False, predicts=False),
    }
)

#: The parts of :class:`~sb3_belief.belief.AdaptiveBelief`, ``belief="adaptive"``, which is no variant of the paper's network
ADAPTIVE = Variant(attends=True, samples=False, predicts=True, online=True)
