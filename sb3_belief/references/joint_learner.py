"""What learners that act for a whole team have in common: which environments they take, and what is saved of them."""

from typing import ClassVar

from gymnasium import spaces
from stable_baselines3.common.type_aliases import GymEnv

from sb3_belief.common.safe_files.algorithm import SafeFilesMixin


def check_joint_env(
    env: GymEnv | str, learner: str, actions: tuple[type[spaces.Space], ...] = (spaces.MultiDiscrete,)
) -> None:
    """
    Check that a joint learner can learn in an environment.

    :param env: What the user gave
    :param learner: What it is called
    :param actions: The kinds of joint actions that the learner chooses
    :raises ValueError: If it cannot, with what it needs
    """
    observed = getattr(env, "observation_space", None)
    if not isinstance(observed, spaces.Dict) or not {"obs", "state", "active"} <= observed.spaces.keys():
        raise ValueError(
            f"{learner} learns in a team's environment shown as one: JointVecEnv(make_team_env(...)) of"
            f" sb3_belief.references, not in {env!r}."
        )
    joint = getattr(env, "action_space", None)
    if not isinstance(joint, actions):
        raise ValueError(f"{learner} needs agents with Discrete actions, and those of this environment are Box: {joint}.")


class JointLearnerMixin(SafeFilesMixin):
    """
    Stands before SB3's class among the bases of an algorithm that learns in a ``JointVecEnv``.

    An environment of another kind, or one that normalises, is refused with a ``ValueError``: the given one by
    ``_check_joint_env``, which ``__init__`` calls first, and any later one by ``set_env``.
    """

    #: The kinds of joint actions that the algorithm chooses
    joint_actions: ClassVar[tuple[type[spaces.Space], ...]] = (spaces.MultiDiscrete,)
    #: Names of the policy's optimisers, whose states are saved with it
    optimizer_names: ClassVar[tuple[str, ...]] = ("optimizer",)

    def _check_joint_env(self, env: GymEnv | str | None) -> None:
        # A model that is loaded may have none yet
        if env is not None:
            check_joint_env(env, type(self).__name__, self.joint_actions)

    def _setup_model(self) -> None:
        self._refuse_normalisation()
        super()._setup_model()  # type: ignore[safe-super]

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        self._check_joint_env(env)
        super().set_env(env, force_reset)
        self._refuse_normalisation()

    def _refuse_normalisation(self) -> None:
        if self.get_vec_normalize_env() is not None:
            raise ValueError(
                f"{type(self).__name__} does not take normalised observations, since masks and states are among them: leave"
                " normalize out."
            )

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", *(f"policy.{name}" for name in self.optimizer_names)], []
