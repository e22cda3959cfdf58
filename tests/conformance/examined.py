"""The classes that sit the exam: ours as a user gets them, and the same among others who act at random."""

import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
import sb3_contrib
import stable_baselines3
from gymnasium import spaces
from stable_baselines3.common import policies
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, is_vecenv_wrapped
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_belief import BeliefActorCriticPolicy, BeliefPPO, MaskableBeliefPPO

if TYPE_CHECKING:
    _Algorithm = BeliefPPO
else:
    _Algorithm = object

#: Who acts beside the agent in the second pass
OTHERS: dict[str, spaces.Space] = {"chooser": spaces.Discrete(3), "mover": spaces.Box(-1.0, 1.0, (2,), np.float32)}


class AmongOthers(VecEnvWrapper):
    """Names others, and brings with each step what they did at random and whether the agent saw it."""

    def __init__(self, venv: VecEnv) -> None:
        super().__init__(venv)
        self.rng = np.random.default_rng(0)

    def seed(self, seed: int | None = None) -> Any:
        self.rng = np.random.default_rng(seed)
        return self.venv.seed(seed)

    def has_attr(self, attr_name: str) -> bool:
        return attr_name == "others_action_spaces" or self.venv.has_attr(attr_name)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        if attr_name == "others_action_spaces":
            return [OTHERS for _ in self._get_indices(indices)]
        return self.venv.get_attr(attr_name, indices)

    def reset(self) -> VecEnvObs:
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        observations, rewards, dones, infos = self.venv.step_wait()
        # a suite's own VecEnv may leave them out
        infos = infos or [{} for _ in range(self.num_envs)]
        for info in infos:
            visible = self.rng.random(len(OTHERS)) < 0.6
            chosen = np.eye(3)[self.rng.integers(3)] * visible[0]
            moved = self.rng.uniform(-1.0, 1.0, 2) * visible[1]
            info["others_actions"] = np.concatenate([chosen, moved]).astype(np.float32)
            info["others_visible"] = visible
        return observations, rewards, dones, infos


class BroughtAmongOthers(_Algorithm):
    """Puts others into every environment that it is given, so that no test need know of them."""

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        wrapped = BaseAlgorithm._wrap_env(env, verbose, monitor_wrapper)
        return wrapped if is_vecenv_wrapped(wrapped, AmongOthers) else AmongOthers(wrapped)


class QuietAlone(_Algorithm):
    """
    Leaves out the one warning that an environment names no others. Here that is every environment, and some tests are about
    which warnings there are.
    """

    def _setup_model(self) -> None:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="The environment names no other agents")
            super()._setup_model()


class Alone(QuietAlone, BeliefPPO):
    """Ours as a user gets it."""


# To a type checker SB3's and contrib's own attributes differ
class MaskableAlone(QuietAlone, MaskableBeliefPPO):  # type: ignore[misc]
    """Ours as a user gets it."""


class Among(BroughtAmongOthers, BeliefPPO):
    """The same with an active belief."""


class MaskableAmong(BroughtAmongOthers, MaskableBeliefPPO):  # type: ignore[misc]
    """The same with an active belief."""


#: By pass, in place of PPO and MaskablePPO
EXAMINED: dict[str, tuple[type[BaseAlgorithm], type[BaseAlgorithm]]] = {
    "none": (Alone, MaskableAlone),
    "active": (Among, MaskableAmong),
}


def put_in_place(belief: str) -> list[type[BaseAlgorithm]]:
    """
    Give out our classes wherever SB3 and contrib offer theirs to import, and our policy to derive one's own from.

    :param belief: ``"none"`` or ``"active"``
    :return: Our algorithms
    """
    ppo, maskable_ppo = EXAMINED[belief]
    # tests' ids, and a message that one of them expects, have the class's name in them
    ppo.__name__, maskable_ppo.__name__ = "PPO", "MaskablePPO"
    stable_baselines3.PPO = stable_baselines3.ppo.PPO = ppo  # type: ignore[misc, assignment]
    sb3_contrib.MaskablePPO = sb3_contrib.ppo_mask.MaskablePPO = maskable_ppo  # type: ignore[misc, assignment]
    policies.ActorCriticPolicy = BeliefActorCriticPolicy  # type: ignore[misc]
    return [ppo, maskable_ppo]
