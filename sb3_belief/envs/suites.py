"""The families of environments that come from other packages: ``family/name``."""

import difflib
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.machinery import PathFinder
from importlib.util import find_spec
from types import MappingProxyType
from typing import Any


@dataclass(frozen=True)
class Suite:
    """
    How to make the environments of one package. It is data: nothing of the package is imported before one is made.

    :param name: what stands before the slash of an id
    :param make: ``"module:callable"``; ``callable(name, **env_kwargs)`` returns one copy, a PettingZoo ``ParallelEnv``
    :param modules: modules that must be there
    :param install: the line that installs them
    :param batched: ``"module:callable"``; ``callable(name, n_envs, **env_kwargs)`` returns a ``TeamVecEnv`` that steps all
        copies at once. None: there is none
    :param names: ``"module:callable"``; ``callable()`` returns the names that the package knows. None: they cannot be listed
    :param note: what else has to be known to install it, one sentence
    """

    name: str
    make: str
    modules: tuple[str, ...]
    install: str
    batched: str | None = None
    names: str | None = None
    note: str = ""

    def missing(self) -> list[str]:
        """
        :return: the modules that are not installed; finding out imports none of them
        """
        return [module for module in self.modules if not is_installed(module)]

    def known_names(self) -> list[str]:
        """
        :return: the names that the package knows, as far as it can be asked: it must be installed
        """
        return [] if self.names is None or self.missing() else list(load(self.names)())

    def require(self, id: str) -> None:
        """
        :param id: of the environment that is asked for, for the message
        :raises ModuleNotFoundError: if the package is not installed, with the line that installs it
        """
        missing = self.missing()
        if missing:
            note = f" {self.note}" if self.note else ""
            raise ModuleNotFoundError(
                f"{id!r} needs {' and '.join(map(repr, missing))}, which is not installed: {self.install}.{note}",
                name=missing[0],
            )


_ADAPTERS = "sb3_belief.envs.adapters"


def _family(name: str, modules: str, install: str, batched: bool = False, note: str = "") -> Suite:
    adapter = f"{_ADAPTERS}.{name}"
    return Suite(
        name=name,
        make=f"{adapter}:make",
        modules=(modules,),
        install=install,
        batched=f"{adapter}:make_batched" if batched else None,
        names=f"{adapter}:names",
        note=note,
    )


_STARCRAFT = "It needs StarCraft II itself too, and pysc2 needs protobuf<3.21."

SUITES: Mapping[str, Suite] = MappingProxyType(
    {
        family.name: family
        for family in (
            _family("mpe", "mpe2", "pip install mpe2"),
            _family("pettingzoo", "pettingzoo", "pip install 'pettingzoo[all]'"),
            _family("lbf", "lbforaging", "pip install lbforaging"),
            _family("rware", "rware", "pip install rware"),
            _family(
                "smaclite",
                "smaclite",
                # Its own requirements bring pygame beside pygame-ce, and an Rtree that needs libspatialindex on the system
                "pip install --no-deps git+https://github.com/uoe-agents/smaclite.git && "
                "pip install scikit-learn 'rtree>=1.1' pygame-ce",
            ),
            _family(
                "smax",
                "jaxmarl",
                "pip install jaxmarl",
                batched=True,
                note="It needs gymnasium<1.4, so give it a virtual environment of its own.",
            ),
            _family(
                "smac",
                # The other project of this name has a module 'smac' too, but not this one
                "smac.env.starcraft2",
                "pip install git+https://github.com/oxwhirl/smac.git",
                note=f"Not 'pip install smac', which installs another project (hyper-parameter optimisation). {_STARCRAFT}",
            ),
            _family("smacv2", "smacv2", "pip install git+https://github.com/oxwhirl/smacv2.git", note=_STARCRAFT),
        )
    }
)


def load(target: str) -> Any:
    """
    :param target: ``"module:attribute"``
    :return: what it names
    """
    module, _, attribute = target.partition(":")
    return getattr(import_module(module), attribute)


def is_installed(module: str) -> bool:
    """
    :param module: name of a module, with dots if it lies in a package
    :return: whether it can be found; neither it nor its package is imported to find out
    """
    if module in sys.modules:
        return sys.modules[module] is not None
    root, *rest = module.split(".")
    try:
        found = find_spec(root)
    except ValueError:
        # Something put into sys.modules by hand, without a specification
        return False
    name = root
    for part in rest:
        if found is None or found.submodule_search_locations is None:
            return False
        name = f"{name}.{part}"
        found = PathFinder.find_spec(name, list(found.submodule_search_locations))
    return found is not None


def nearest(given: object, names: Iterable[str], most: int = 3, cutoff: float = 0.4) -> str:
    """
    :param given: what was typed
    :param names: what could have been
    :param most: how many names are suggested at most
    :param cutoff: how alike they must be, in [0, 1]
    :return: `` Did you mean 'x'?`` (with the leading space), or nothing if none is near
    """
    near = difflib.get_close_matches(str(given), list(names), n=most, cutoff=cutoff)
    return f" Did you mean {' or '.join(map(repr, near))}?" if near else ""


def unknown_name(family: str, name: str, names: Iterable[str]) -> ValueError:
    """
    :param family: name of the family
    :param name: the name that it does not have
    :param names: those that it has
    :return: the error to raise, with the nearest names and all of them
    """
    names = list(names)
    return ValueError(f"The family {family!r} has no {name!r}.{nearest(name, names)} It has: {listed(names)}.")


def listed(names: Sequence[str], most: int = 40) -> str:
    """
    :param names: any number of names
    :param most: how many of them are written out
    :return: them for a message
    """
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
