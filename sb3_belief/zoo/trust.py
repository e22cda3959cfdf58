"""
A saved team is data: what it holds is looked at before it is loaded.

Loading a model unpickles parts of its file, and a pickle can call anything. Here it may only name classes of the known
packages, so that the file of a stranger runs no code of its own. What a user's own packages define needs ``--allow-package``,
and a function that was saved as code (a lambda as a learning rate) the flag ``--trust``.
"""

import base64
import enum
import inspect
import io
import json
import pickle
import zipfile
from pathlib import Path
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule
from stable_baselines3.common.vec_env import VecNormalize

from sb3_belief.team.checkpoint import agent_file
from sb3_belief.zoo.errors import ConfigError, cause
from sb3_belief.zoo.names import ALLOWED_PACKAGES, is_allowed

# What plain data of Python and numpy is rebuilt with; none of it calls what it is given
_DATA = {
    "builtins": "bool bytearray bytes complex dict float frozenset int list object range set slice str tuple",
    "collections": "OrderedDict deque",
    "copyreg": "_reconstructor",
    "numpy": "dtype ndarray",
    "numpy._core.multiarray numpy.core.multiarray": "_reconstruct scalar",
    "numpy._core.numeric numpy.core.numeric": "_frombuffer",
    "numpy.random._pickle": "__bit_generator_ctor __generator_ctor __randomstate_ctor",
    "numpy.random._pcg64": "PCG64",
    "numpy.random._mt19937": "MT19937",
    "numpy.random._philox": "Philox",
    "numpy.random._sfc64": "SFC64",
    "numpy.random.bit_generator": "SeedSequence __pyx_unpickle_SeedSequence",
}
_NAMES = {(module, name) for modules, names in _DATA.items() for module in modules.split() for name in names.split()}
_KINDS = (
    *(th.nn.Module, th.optim.Optimizer, spaces.Space, BaseBuffer, ActionNoise, VecNormalize, RunningMeanStd, enum.Enum, tuple),
    *(ConstantSchedule, FloatSchedule, LinearSchedule),
)


class _Untrusted(Exception):
    """Raised for a part of a file that could run code. Its text says what it names."""


class _Reader(pickle.Unpickler):
    """
    Unpickler for which nothing but plain data and classes of known packages exists.

    :param content: The pickle
    :param packages: Packages of which everything may be named
    """

    def __init__(self, content: bytes, packages: tuple[str, ...]) -> None:
        super().__init__(io.BytesIO(content))
        self._packages = packages

    def find_class(self, module: str, name: str) -> Any:
        """Return what a pickle names, if it may."""
        if (module, name) == ("builtins", "getattr"):
            # How Python 3.11.0 to 3.11.3 name the member of an Enum, such as SB3's unit of train_freq
            return _member
        if is_allowed(module, self._packages):
            return super().find_class(module, name)
        if (module, name) not in _NAMES:
            if not is_allowed(module, (*ALLOWED_PACKAGES, "gymnasium.spaces")) or "." in name:
                raise _Untrusted(f"{module}.{name}")
            found = super().find_class(module, name)
            if not (inspect.isclass(found) and issubclass(found, _KINDS)):
                raise _Untrusted(f"{module}.{name}")
            return found
        return super().find_class(module, name)


def _member(enum_class: Any, name: str) -> enum.Enum:
    """Return a member of an Enum, for which alone a pickle may use ``getattr``."""
    if not (inspect.isclass(enum_class) and issubclass(enum_class, enum.Enum) and name in enum_class.__members__):
        raise _Untrusted("builtins.getattr")
    return enum_class[name]


def check_saved_team(path: Path, where: str, extra_packages: tuple[str, ...] = (), or_single_agent: bool = False) -> None:
    """
    Check that loading a saved team runs no code but that of known packages.

    :param path: Zip of the team
    :param where: Flag or command that it was given to, for the error message
    :param extra_packages: Further packages that the user allows
    :param or_single_agent: Whether the zip of a single SB3 model will do, too
    :raises ConfigError: If the file names anything else, or cannot be read. The message names the agent
    """
    agent = ""
    try:
        with zipfile.ZipFile(path) as team:
            if {"data", "policy.pth"} <= set(team.namelist()):
                if or_single_agent:
                    agent = path.stem
                    return _check_model(path.read_bytes(), extra_packages)
                raise ValueError("it is the zip of a single SB3 model, which its own class loads")
            for agent, class_name in json.loads(team.read("team.json"))["classes"].items():
                module = str(class_name).partition(":")[0]
                if not is_allowed(module, (*ALLOWED_PACKAGES, *extra_packages)):
                    raise _Untrusted(str(class_name))
                file = agent_file(agent, team.namelist())
                _check_model(team.read(f"{file}.zip"), extra_packages)
                if f"{file}.vecnormalize.pkl" in team.namelist():
                    _Reader(team.read(f"{file}.vecnormalize.pkl"), extra_packages).load()
    except _Untrusted as error:
        raise ConfigError(
            f"{where}: {str(path)!r} is not loaded, because agent {agent!r} needs {str(error)[:100]!r}, which could run any"
            " code. If you trust the file: --allow-package NAME for a package of yours, --trust for anything."
        ) from None
    # A damaged file makes zipfile, json and pickle raise whatever they raise
    except Exception as error:
        saved = f"the file of agent {agent!r}" if agent else "its team.json"
        raise ConfigError(
            f"{where}: {str(path)!r} is no saved team, or damaged: {saved} cannot be read ({cause(error)})"
        ) from error


def _check_model(content: bytes, packages: tuple[str, ...]) -> None:
    with zipfile.ZipFile(io.BytesIO(content)) as model:
        for value in json.loads(model.read("data")).values():
            if isinstance(value, dict) and ":serialized:" in value:
                _Reader(base64.b64decode(value[":serialized:"]), packages).load()
        for name in model.namelist():
            if name.endswith(".pth"):
                # As SB3 loads it; here a damaged file is still known by its agent
                th.load(io.BytesIO(model.read(name)), map_location="cpu", weights_only=True)
