"""The normalisation of an agent that is not in play all the time."""

import copyreg
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn


class AgentNormalize(VecNormalize):
    """
    ``VecNormalize`` that leaves out of its statistics what an agent is given while it is out of play.

    That are the rewards of inactive steps, the observations after them (the one with which it comes back is therefore left
    out, too), and the zeros that follow when it leaves. For an agent that is always in play it is SB3's, bit for bit. It is
    pickled as a ``VecNormalize``, so that its files need nothing of this package.
    """

    @classmethod
    def from_saved(cls, statistics: VecNormalize) -> "AgentNormalize":
        """
        Take over statistics that have been loaded.

        :param statistics: Without an environment
        :return: The same statistics, without an environment
        """
        own = cls.__new__(cls)
        vars(own).update(vars(statistics))
        return own

    def __reduce__(self) -> tuple[Any, ...]:
        # What VecNormalize.__getstate__() leaves out, which fails without an environment
        left_out = ("venv", "class_attributes", "returns")
        state = {name: value for name, value in vars(self).items() if name not in left_out}
        # What pickle itself names where it means object.__new__. That method would be looked up by getattr, which no safe
        # loader allows
        return copyreg._reconstructor, (VecNormalize, object, None), state  # type: ignore[attr-defined]

    def step_wait(self) -> VecEnvStepReturn:
        """
        Step, and normalise as ``VecNormalize`` does.

        :return: Observations, rewards, dones and infos of the agent
        """
        step: Any = self.venv.step_wait()
        obs, rewards, dones, infos = step
        active = np.array([info["active"] for info in infos])
        seen = active & (~dones | _any_nonzero(obs, dones)) | np.array(["episode" in info for info in infos])
        venv, training = self.venv, self.training
        if training and not (active.all() and seen.all()):
            self._update(obs, rewards, seen, active)
            self.training = False
        # SB3's own method does the rest with the step that has been taken
        self.venv = _Taken(step)  # type: ignore[assignment]
        try:
            return super().step_wait()
        finally:
            self.venv, self.training = venv, training

    def _update(self, obs: Any, rewards: np.ndarray, seen: np.ndarray, active: np.ndarray) -> None:
        """Update the statistics by the rows that count, as ``VecNormalize`` does by all."""
        if self.norm_obs and seen.any():
            if isinstance(self.obs_rms, dict):
                for key, statistics in self.obs_rms.items():
                    statistics.update(obs[key][seen])
            else:
                self.obs_rms.update(obs[seen])
        # What comes after an agent's death may still count for what it did before: its return goes on
        self.returns = self.returns * self.gamma + rewards
        if active.any():
            self.ret_rms.update(self.returns[active])


class _Taken:
    """
    Stands for an environment in the very step that it has taken.

    :param step: What its ``step_wait`` has returned
    """

    def __init__(self, step: VecEnvStepReturn):
        self._step = step

    def step_wait(self) -> VecEnvStepReturn:
        """Return the step."""
        return self._step


def _any_nonzero(obs: Any, dones: np.ndarray) -> np.ndarray:
    """Return in which copies an observation is not all zero: bool ``[n_envs]``. It is only computed where there is a done."""
    if not dones.any():
        return ~dones
    parts = obs.values() if isinstance(obs, dict) else [obs]
    return np.any([np.reshape(part, (len(dones), -1)).any(axis=1) for part in parts], axis=0)
