"""What a file may name: classes of known packages, what the user allows besides, or anything."""

import enum
import inspect
from collections.abc import Iterable
from typing import Any, NamedTuple

import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule
from stable_baselines3.common.vec_env import VecNormalize

#: Packages, or parts of packages, of which a saved model may name classes
MODEL_PACKAGES = ("sb3_belief", "stable_baselines3", "sb3_contrib", "torch.nn", "torch.optim", "gymnasium.spaces")
# The kinds of classes of theirs. Others could do something when they are made or called: write a file, or read a pickle
_KINDS = (
    *(th.nn.Module, th.optim.Optimizer, spaces.Space, BaseBuffer, ActionNoise, VecNormalize, RunningMeanStd, enum.Enum),
    *(tuple, ConstantSchedule, FloatSchedule, LinearSchedule),
)
#: What it means to unpickle, for messages
PICKLE = "a pickle can run any code of whoever made the file"


class Trust(NamedTuple):
    """
    Whom a file is trusted to name.

    :param trust_pickle: Whether to unpickle what the file holds, which lets it do anything
    :param allow_packages: Packages of the user's own of which it may name classes and functions
    """

    trust_pickle: bool = False
    allow_packages: tuple[str, ...] = ()

    @classmethod
    def of(cls, trust_pickle: bool, allow_packages: Iterable[str]) -> "Trust":
        """
        Return the trust that a user's arguments stand for.

        :param trust_pickle: See the class
        :param allow_packages: See the class
        :return: The trust
        :raises TypeError: If the packages are no list of names
        """
        if isinstance(allow_packages, str) or not all(isinstance(each, str) for each in allow_packages):
            raise TypeError(
                f"allow_packages is {allow_packages!r}; it must be a list of names of packages, such as ('my_package',)."
            )
        return cls(bool(trust_pickle), tuple(allow_packages))

    def allowed(self, module: str) -> bool:
        """
        Return whether a module may be imported for what a file names.

        :param module: Full name of the module
        """
        return self.trust_pickle or is_allowed(module, (*MODEL_PACKAGES, *self.allow_packages))

    def accepts(self, found: Any) -> bool:
        """
        Return whether a class or function may be used that a file names.

        :param found: The class or function
        """
        if self.trust_pickle or is_allowed(found.__module__, self.allow_packages):
            return True
        return inspect.isclass(found) and issubclass(found, _KINDS)


#: Trust in known packages only
UNTRUSTED = Trust()


def is_allowed(module: str, packages: Iterable[str]) -> bool:
    """
    Return whether a module belongs to one of some packages.

    :param module: Full name of the module
    :param packages: Names of packages, or of parts of packages
    :return: Whether it is one of them, or lies in one
    """
    return any(module == package or module.startswith(package + ".") for package in packages)
