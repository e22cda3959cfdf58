"""The options of a belief, and checks of what makes no sense."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from numbers import Integral

from sb3_belief.belief import ACTION_LOSSES, ADAPTIVE, ROW_FEATURES, SIMILARITIES, VARIANTS, ActionLayout, Variant
from sb3_belief.common.checks import check_integer

#: The variants, and PPO without a belief
_VARIANTS = {**VARIANTS, "adaptive": ADAPTIVE}
BELIEFS = (*_VARIANTS, "none")
POLICY_LATENTS = ("sample", "mean")
#: Default widths of the embeddings and of the belief
EMBEDDING_DIM = 64
LATENT_DIM = 64


@dataclass(frozen=True)
class BeliefOptions:
    """
    The belief's arguments, as :class:`~sb3_belief.BeliefPPO` explains them.

    :raises ValueError: For a value that makes no sense; the message says what is allowed
    """

    belief: str = "dynamic"
    history_length: int = 800
    keep_ratio: float = 0.05
    action_loss: str | None = None
    policy_latent: str = "sample"
    similarity: str = "embedding"
    detach_belief: bool = False
    n_own: int = 32
    n_pool: int = 32
    row_features: Sequence[str] = ROW_FEATURES
    history_dropout: float = 0.0
    belief_replay: int = 16
    prediction_steps: int = 1
    critic_sees_others: bool = False

    def __post_init__(self) -> None:
        _check_choice("belief", self.belief, BELIEFS)
        if self.action_loss is not None:
            _check_choice("action_loss", self.action_loss, ACTION_LOSSES)
        _check_choice("policy_latent", self.policy_latent, POLICY_LATENTS)
        _check_choice("similarity", self.similarity, SIMILARITIES)
        if not isinstance(self.history_length, Integral) or self.history_length < 1:
            raise ValueError(
                f"history_length is {self.history_length!r}; it must be an integer of at least 1, so that there is a row to "
                "attend to (the paper uses 800). For a belief without a history use belief='variational' or 'static'."
            )
        if not 0 < self.keep_ratio <= 1:
            raise ValueError(
                f"keep_ratio is {self.keep_ratio!r}; it must be in (0, 1]: the share of the history attended to (the paper "
                "uses 0.05). For a belief that attends to none of it use belief='variational' or 'static'."
            )
        self._check_online()
        if self.detach_belief and self.belief == "wide":
            raise ValueError(
                "belief='wide' is trained by nothing but the gradient of policy and value, which detach_belief=True keeps out "
                "of it; leave detach_belief False."
            )

    def _check_online(self) -> None:
        """Check what belongs to a belief that is online."""
        for name, given in (("n_own", self.n_own), ("n_pool", self.n_pool)):
            check_integer(name, given, 0, "the most rows of the memory that are attended to")
        check_integer("prediction_steps", self.prediction_steps, 1, "of how many steps the others' actions are predicted")
        check_integer("belief_replay", self.belief_replay, 0, "how many past rollouts the belief is trained on, too")
        if not isinstance(self.critic_sees_others, bool):
            raise ValueError(f"critic_sees_others is {self.critic_sees_others!r}; it must be True or False")
        if self.critic_sees_others and self.belief != "adaptive":
            raise ValueError(
                f"critic_sees_others=True belongs to belief='adaptive', and belief is {self.belief!r}; leave it False there"
            )
        if self.belief == "adaptive" and self.n_own + self.n_pool == 0:
            raise ValueError("n_own and n_pool are 0, so nothing would be attended to; for such a belief use belief='static'.")
        if not isinstance(self.row_features, Iterable) or isinstance(self.row_features, str):
            raise ValueError(f"row_features is {self.row_features!r}; it must be a list of some of {', '.join(ROW_FEATURES)}")
        # Lists come from YAML and from files
        object.__setattr__(self, "row_features", tuple(self.row_features))
        for name in self.row_features:
            _check_choice("row_features: an entry", name, ROW_FEATURES)
        dropout = self.history_dropout
        if isinstance(dropout, bool) or not isinstance(dropout, int | float) or not 0 <= dropout < 1:
            raise ValueError(f"history_dropout is {self.history_dropout!r}; it must be in [0, 1): a share of the steps")

    @property
    def variant(self) -> Variant | None:
        """The parts that the belief has; None without a belief."""
        return _VARIANTS.get(self.belief)

    def loss_of(self, layout: ActionLayout) -> str:
        """
        Return the action loss: the one that is given, or else the belief's own.

        :param layout: Layout of the others' actions
        :return: A key of ``ACTION_LOSSES``
        """
        if self.action_loss is not None:
            return self.action_loss
        return "cross_entropy" if self.belief == "adaptive" and "number" not in layout.kinds else "mse"

    def check_others(self, names: Collection[str], layout: ActionLayout) -> None:
        """
        Check that the action loss can be computed for all others.

        :param names: Names of the others, in their order
        :param layout: Layout of their actions
        :raises ValueError: If it cannot be computed for the actions of one of them
        """
        if self.action_loss == "cross_entropy" and self.variant is not None and self.variant.predicts:
            numbers = [name for name, kind in zip(names, layout.kinds, strict=True) if kind == "number"]
            if numbers:
                raise ValueError(
                    f"action_loss='cross_entropy' needs actions that are chosen from a finite set, but those of "
                    f"{', '.join(numbers)} are numbers (Box); use action_loss='mse'."
                )


def _check_choice(name: str, value: str, allowed: Collection[str]) -> None:
    if value not in allowed:
        raise ValueError(f"{name} is {value!r}; it must be one of {', '.join(map(repr, allowed))}")
