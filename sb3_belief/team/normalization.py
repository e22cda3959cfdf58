"""The normalisation of an agent that is not in play all the time."""

import copyreg
from typing import Any

import numpy as np
from stable_baselines3.common.running_mean_std import RunningMeanStd
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

    def share_places(self) -> None:
        """
        Have the agents whose observations are stacked, ``[n, ...]``, share one statistic, as they share weights.

        With one for each place whatever tells agents apart, such as a one-hot id, would be normalised to zero. Statistics that
        have seen something stay as they are.
        """
        if not self.norm_obs:
            return
        if isinstance(self.obs_rms, dict):
            self.obs_rms = {key: _of_one_place(statistics) for key, statistics in self.obs_rms.items()}
        else:
            self.obs_rms = _of_one_place(self.obs_rms)

    @property
    def _has_shared_places(self) -> bool:
        if not self.norm_obs:
            return False
        if isinstance(self.obs_rms, dict):
            spaces_of: Any = self.observation_space
            return any(rms.mean.shape != spaces_of[key].shape for key, rms in self.obs_rms.items())
        return self.obs_rms.mean.shape != self.observation_space.shape

    def reset(self) -> Any:
        """
        Reset, and normalise as ``VecNormalize`` does.

        :return: Observations of the agent
        """
        if not (self.training and self._has_shared_places):
            return super().reset()
        self.training = False
        try:
            super().reset()
        finally:
            self.training = True
        self._update_observations(self.old_obs)
        return self.normalize_obs(self.old_obs)

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
        if training and (not (active.all() and seen.all()) or self._has_shared_places):
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
            self._update_observations({key: part[seen] for key, part in obs.items()} if isinstance(obs, dict) else obs[seen])
        # What comes after an agent's death may still count for what it did before: its return goes on
        self.returns = self.returns * self.gamma + rewards
        if active.any():
            self.ret_rms.update(self.returns[active])

    def _update_observations(self, obs: Any) -> None:
        if isinstance(self.obs_rms, dict):
            for key, statistics in self.obs_rms.items():
                statistics.update(obs[key].reshape(-1, *statistics.mean.shape))
        else:
            self.obs_rms.update(obs.reshape(-1, *self.obs_rms.mean.shape))


def _of_one_place(statistics: RunningMeanStd) -> RunningMeanStd:
    # Their count is a small number before the first observation
    return statistics if statistics.count >= 1 else RunningMeanStd(statistics.count, statistics.mean.shape[1:])


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
