"""Fixtures of the adapters' tests."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import pytest

from tests.envs.adapters import fake_starcraft
from tests.envs.adapters.fake_smacv2 import StarCraftCapabilityEnvWrapper
from tests.envs.adapters.fake_starcraft import MAPS, Faults, StarCraft2Env


@contextmanager
def fake_packages() -> Iterator[Faults]:
    """
    Install the fakes of SMAC and SMACv2 in place of the packages.

    :return: The faults that the fakes make, none at first, and the record of what they were sent
    """
    faults = fake_starcraft.FAULTS = Faults()
    contents: dict[str, dict[str, Any]] = {
        "smac": {},
        "smac.env": {"StarCraft2Env": StarCraft2Env},
        "smac.env.starcraft2": {},
        "smac.env.starcraft2.maps": {},
        "smac.env.starcraft2.maps.smac_maps": {"get_smac_map_registry": lambda: MAPS},
        "smacv2": {},
        "smacv2.env": {},
        "smacv2.env.starcraft2": {},
        "smacv2.env.starcraft2.wrapper": {"StarCraftCapabilityEnvWrapper": StarCraftCapabilityEnvWrapper},
    }
    before = {name: sys.modules.get(name) for name in contents}
    for name, members in contents.items():
        module = ModuleType(name)
        vars(module).update(members)
        sys.modules[name] = module
    try:
        yield faults
    finally:
        for name, module_before in before.items():
            if module_before is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module_before


@pytest.fixture
def faults():
    """Install the fakes, and return what they record and which faults they make."""
    with fake_packages() as made:
        yield made
