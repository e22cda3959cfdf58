"""The fakes of SMAC and SMACv2 have the same interfaces as the real packages."""

import inspect
from importlib.util import find_spec

import pytest

from tests.envs.adapters import fake_smacv2, fake_starcraft


def parameters(function):
    """Return the names of a function's parameters."""
    return list(inspect.signature(function).parameters)


METHODS = (
    "reset step get_obs get_obs_agent get_obs_size get_state get_state_size get_avail_actions get_avail_agent_actions"
    " get_total_actions get_env_info get_visibility_matrix get_obs_move_feats_size get_obs_enemy_feats_size"
    " get_obs_ally_feats_size get_obs_own_feats_size get_unit_by_id unit_sight_range full_restart render close seed"
    " save_replay get_stats"
).split()


@pytest.mark.skipif(find_spec("smac") is None, reason="SMAC is not installed: its interface is compared where it is")
def test_the_fake_has_the_interface_of_the_real_smac():
    from smac.env import StarCraft2Env

    assert parameters(fake_starcraft.StarCraft2Env) == parameters(StarCraft2Env)
    for name in METHODS:
        assert parameters(getattr(fake_starcraft.StarCraft2Env, name)) == parameters(getattr(StarCraft2Env, name)), name


@pytest.mark.skipif(find_spec("smacv2") is None, reason="SMACv2 is not installed: its interface is compared where it is")
def test_the_fake_has_the_interface_of_the_real_smacv2():
    from smacv2.env.starcraft2.starcraft2 import StarCraft2Env
    from smacv2.env.starcraft2.wrapper import StarCraftCapabilityEnvWrapper

    fake = set(parameters(fake_smacv2.StarCraft2EnvV2)) | set(parameters(fake_starcraft.StarCraft2Env))
    assert fake - {"kwargs"} == set(parameters(StarCraft2Env))
    for name in METHODS:
        assert hasattr(StarCraft2Env, name), name
    assert parameters(fake_smacv2.StarCraftCapabilityEnvWrapper) == parameters(StarCraftCapabilityEnvWrapper)
