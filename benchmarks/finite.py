"""
What does it cost to look for what is not finite after each update?

One agent learns in a toy environment. The time of each ``train()`` is compared with that of the same and all that stands
around it: the copy before and the look after. DQN (64x64) and SAC (256x256) update at each step, PPO (64x64) after 1,024.
With ``on_nan="skip"`` the off-policy ones are copied before each update, which has no bar: it is what taking back one costs.
"""

import time
from collections.abc import Callable
from typing import Any
from unittest import mock

import numpy as np
from gymnasium import spaces
from stable_baselines3 import DQN, PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm

from benchmarks.measure import Sample, ratio
from benchmarks.report import Report
from benchmarks.toy_env import N_ACTIONS, ToyTeamEnv
from sb3_belief import Team
from sb3_belief.team.finite import UpdateGuard

_OFF_POLICY: dict[str, Any] = dict(learning_starts=10, buffer_size=10_000, train_freq=1, gradient_steps=1)
_DISCRETE, _BOX = spaces.Discrete(N_ACTIONS), spaces.Box(-1.0, 1.0, (N_ACTIONS,), np.float32)
#: Class, arguments, action space, and number of joint steps in each round
ALGORITHMS: dict[str, tuple[type[BaseAlgorithm], dict[str, Any], spaces.Space, int]] = {
    "dqn": (DQN, _OFF_POLICY, _DISCRETE, 1_000),
    "sac": (SAC, _OFF_POLICY, _BOX, 200),
    "ppo": (PPO, dict(n_steps=1_024, batch_size=64), _DISCRETE, 1_024),
}


class _Clock:
    """
    Adds up the time of a function.

    :param function: The function
    """

    def __init__(self, function: Callable[..., Any]):
        self._function, self.calls, self.wall = function, 0, 0.0

    def __call__(self, *args: Any, **kwargs: Any) -> None:
        # The clock of the CPU takes a system call, which would be much of what is measured
        wall = time.perf_counter()
        self._function(*args, **kwargs)
        self.wall += time.perf_counter() - wall
        self.calls += 1

    def sample(self) -> Sample:
        """Return what was measured."""
        return Sample(self.calls, self.wall, self.wall)


def updates(team: Team, steps: int) -> tuple[Sample, Sample]:
    """
    Let a team of one learn.

    :param team: The team
    :param steps: Number of joint steps
    :return: The updates alone, and with what stands around them
    """
    (model,) = team.agents.values()
    bare = _Clock(type(model).train.__get__(model))  # type: ignore[attr-defined]
    checked = UpdateGuard._checked_train
    around = _Clock(lambda guard, *args, **kwargs: checked(guard, *args, **kwargs))
    with (
        mock.patch.object(model, "train", bare, create=True),
        mock.patch.object(UpdateGuard, "_checked_train", lambda *args, **kwargs: around(*args, **kwargs)),
    ):
        team.learn(steps, reset_num_timesteps=False)
    return bare.sample(), around.sample()


def run(report: Report) -> None:
    """Measure part ``finite``."""
    report.title("finite", "updates with the search for what is not finite, against updates alone")
    for name, (algo_class, kwargs, action_space, steps) in ALGORITHMS.items():
        for on_nan in ("raise", "skip"):
            if name == "ppo":
                kwargs = {**kwargs, "n_steps": 64} if report.quick else kwargs
            team = Team(
                algo_class,
                "MlpPolicy",
                ToyTeamEnv(1, 1, action_space=action_space),
                seed=0,
                device="cpu",
                on_nan=on_nan,
                **kwargs,
            )
            n_steps = 64 if report.quick else steps
            # The first one fills the replay buffer a little, and PyTorch's caches
            taken = [updates(team, n_steps) for _ in range(1 + report.rounds)][1:]
            bare, around = [sample for sample, _ in taken], [sample for _, sample in taken]
            key = f"checks_{name}" if on_nan == "raise" else f"checks_{name}_skip"
            report.add_ratio(key, ratio(bare, around), f"time of updates of {name} with the search ({on_nan}) / alone")
