"""The beliefs that the paper compares (Table 2), and controls for what they add."""

from types import MappingProxyType
from typing import NamedTuple


class Variant(NamedTuple):
    """
    :param attends: Whether the belief is inferred from the agent's history too (eq. 3 and 4), or from the observation alone
    :param samples: Whether it is a distribution (eq. 5), held to the prior by the KL divergence, or a single point
    :param predicts: Whether it is trained by predicting the others' actions (eq. 7)
    """

    attends: bool
    samples: bool
    predicts: bool


#: ``dynamic`` is the paper's method, ``static`` and ``variational`` are its ablations ("static belief", "belief with LVI"),
#: ``context`` completes the two by two. ``wide`` has as many weights as ``dynamic`` and none of its ideas: what it gains over
#: no belief at all, a larger network gains.
VARIANTS: MappingProxyType[str, Variant] = MappingProxyType(
    {
        "dynamic": Variant(attends=True, samples=True, predicts=True),
        "context": Variant(attends=True, samples=False, predicts=True),
        "variational": Variant(attends=False, samples=True, predicts=True),
        "static": Variant(attends=False, samples=False, predicts=True),
        "wide": Variant(attends=False, samples=False, predicts=False),
    }
)
