"""Suites: environments of other packages, whose ids are ``suite/name``."""

import difflib
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from importlib.machinery import PathFinder
from importlib.util import find_spec
from types import MappingProxyType
from typing import Any


@dataclass(frozen=True)
class Suite:
    """
    Description of how to make the environments of one package.

    A suite is plain data. Nothing of the package is imported before one of its environments is made.

    :param name: Part of an id before the slash
    :param make: ``"module:callable"``. ``callable(name, **env_kwargs)`` returns one copy, a PettingZoo ``ParallelEnv``
    :param modules: Modules that must be installed
    :param install: Command line that installs them
    :param batched: ``"module:callable"``. ``callable(name, n_envs, **env_kwargs)`` returns a ``TeamVecEnv`` that steps all
        copies at once. None if the suite has no such class
    :param names: ``"module:callable"``. ``callable()`` returns the names of the package's environments. None if they cannot
        be listed
    :param note: One sentence about anything else that the installation needs
    :param needs: {beginning of names: (modules, command line that installs them)} for environments that need more than the
        suite itself
    """

    name: str
    make: str
    modules: tuple[str, ...]
    install: str
    batched: str | None = None
    names: str | None = None
    note: str = ""
    needs: Mapping[str, tuple[tuple[str, ...], str]] = field(default_factory=dict)

    def missing(self) -> list[str]:
        """
        Return the modules that are not installed, without importing any of them.

        :return: Names of modules, in the order of ``modules``
        """
        return [module for module in self.modules if not is_installed(module)]

    def missing_for(self, name: str) -> tuple[list[str], str]:
        """
        Return what an environment needs beyond the suite itself and is not installed.

        :param name: Name of the environment
        :return: Names of modules, and the command line that installs them
        """
        missing: list[str] = []
        install = ""
        for beginning, (modules, command) in self.needs.items():
            lacking = [module for module in modules if name.startswith(beginning) and not is_installed(module)]
            if lacking:
                missing, install = missing + lacking, command
        return missing, install

    def known_names(self) -> list[str]:
        """
        Return the names of the package's environments.

        :return: Names, or an empty list if the package is not installed or its environments cannot be listed
        """
        return [] if self.names is None or self.missing() else list(load_attribute(self.names)())

    def require(self, id: str) -> None:
        """
        Check that the package is installed.

        :param id: Id of the environment that was asked for, for the message
        :raises ModuleNotFoundError: If the package is not installed. The message has the line that installs it
        """
        missing = self.missing()
        if missing:
            note = f" {self.note}" if self.note else ""
            raise ModuleNotFoundError(
                f"{id!r} needs {' and '.join(map(repr, missing))}, which is not installed: {self.install}.{note}",
                name=missing[0],
            )


_ADAPTERS = "sb3_belief.envs.adapters"


_ATARI = "pip install 'pettingzoo[atari]' && AutoROM --accept-license"
_CLASSIC, _SISL = "pip install 'pettingzoo[classic]'", "pip install 'pettingzoo[sisl]'"
# What the modules of PettingZoo's environments import
_PETTINGZOO_NEEDS: Mapping[str, tuple[tuple[str, ...], str]] = {
    "atari.": (("multi_agent_ale_py", "pygame"), _ATARI),
    "butterfly.": (("pygame",), "pip install 'pettingzoo[butterfly]'"),
    "butterfly.pistonball": (("pymunk",), "pip install 'pettingzoo[butterfly]'"),
    "classic.": (("pygame",), _CLASSIC),
    "classic.chess": (("chess",), _CLASSIC),
    "classic.hanabi": (("shimmy",), _CLASSIC),
    "classic.leduc_holdem": (("rlcard",), _CLASSIC),
    "classic.texas_holdem": (("rlcard",), _CLASSIC),
    "sisl.": (("pygame",), _SISL),
    "sisl.multiwalker": (("Box2D",), _SISL),
    "sisl.pursuit": (("scipy",), _SISL),
}


def _suite(
    name: str,
    module: str,
    install: str,
    batched: bool = False,
    note: str = "",
    needs: Mapping[str, tuple[tuple[str, ...], str]] | None = None,
) -> Suite:
    adapter = f"{_ADAPTERS}.{name}"
    return Suite(
        name=name,
        make=f"{adapter}:make",
        modules=(module,),
        install=install,
        batched=f"{adapter}:make_batched" if batched else None,
        names=f"{adapter}:names",
        note=note,
        needs=needs or {},
    )


_STARCRAFT = "It also needs StarCraft II itself, and pysc2 needs protobuf<3.21."

SUITES: Mapping[str, Suite] = MappingProxyType(
    {
        suite.name: suite
        for suite in (
            _suite("mpe", "mpe2", "pip install mpe2"),
            _suite("pettingzoo", "pettingzoo", "pip install 'pettingzoo[all]'", needs=_PETTINGZOO_NEEDS),
            _suite("lbf", "lbforaging", "pip install lbforaging"),
            _suite("rware", "rware", "pip install rware"),
            _suite(
                "smaclite",
                "smaclite",
                # With its own requirements pip would install pygame, which conflicts with pygame-ce, and an old Rtree that
                # needs libspatialindex from the system
                "pip install --no-deps git+https://github.com/uoe-agents/smaclite.git && "
                "pip install scikit-learn 'rtree>=1.1' pygame-ce",
            ),
            _suite(
                "smax",
                "jaxmarl",
                "pip install jaxmarl 'gymnasium<1.4'",
                batched=True,
                note="It needs Python 3.11 or later. Because of its older gymnasium give it a virtual environment of its own.",
            ),
            _suite(
                "smac",
                # Another project on PyPI has a module 'smac' too, but no module 'smac.env.starcraft2'
                "smac.env.starcraft2",
                "pip install git+https://github.com/oxwhirl/smac.git",
                note=f"Not 'pip install smac', which installs another project (hyper-parameter optimisation). {_STARCRAFT}",
            ),
            _suite("smacv2", "smacv2", "pip install git+https://github.com/oxwhirl/smacv2.git", note=_STARCRAFT),
        )
    }
)


def load_attribute(target: str) -> Any:
    """
    Import a module and return one of its attributes.

    :param target: ``"module:attribute"``
    :return: The attribute
    """
    module, _, attribute = target.partition(":")
    return getattr(import_module(module), attribute)


def is_installed(module: str) -> bool:
    """
    Return whether a module can be found, without importing it or a package that contains it.

    :param module: Name of the module, with dots if it lies in a package
    :return: Whether it is installed
    """
    if module in sys.modules:
        return sys.modules[module] is not None
    # find_spec("a.b") would import the package a, so only the root is looked up this way and the rest in its folders
    root, *rest = module.split(".")
    try:
        spec = find_spec(root)
    except ValueError:
        # The entry in sys.modules was made by hand and has no specification
        return False
    name = root
    for part in rest:
        if spec is None or spec.submodule_search_locations is None:
            return False
        name = f"{name}.{part}"
        spec = PathFinder.find_spec(name, list(spec.submodule_search_locations))
    return spec is not None


def nearest(given: object, names: Iterable[str], most: int = 3, cutoff: float = 0.4) -> str:
    """
    Return a suggestion for a misspelt name, to be appended to an error message.

    :param given: What the user typed
    :param names: The names that exist
    :param most: Largest number of names to suggest
    :param cutoff: How similar a name must be to be suggested, in [0, 1]
    :return: `` Did you mean 'x'?`` with the leading space, or an empty string if no name is similar enough
    """
    near = difflib.get_close_matches(str(given), list(names), n=most, cutoff=cutoff)
    return f" Did you mean {' or '.join(map(repr, near))}?" if near else ""


def unknown_name(suite: str, name: str, names: Iterable[str]) -> ValueError:
    """
    Return the error for a name that a suite does not have.

    :param suite: Name of the suite
    :param name: The name that does not exist
    :param names: The names that exist
    :return: The error to raise, with the nearest names and all others
    """
    names = list(names)
    return ValueError(f"The suite {suite!r} has no {name!r}.{nearest(name, names)} It has: {comma_separated(names)}.")


def comma_separated(names: Sequence[str], most: int = 40) -> str:
    """
    Return names as one string, abbreviated if there are many.

    :param names: The names
    :param most: Largest number of names to write out
    :return: The first ``most`` names with commas between them, and how many more there are
    """
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
