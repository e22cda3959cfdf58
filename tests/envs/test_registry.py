import subprocess
import sys
from typing import Any

import pytest

from sb3_belief.envs import (
    EnvSpec,
    SwitchingConvention,
    TrafficJunction,
    make_batched_env,
    make_parallel_env,
    registered_ids,
    spec,
)
from sb3_belief.envs import registry as registry_module
from sb3_belief.envs.switching_convention.vec_env import SwitchingConventionVecEnv
from sb3_belief.envs.traffic_junction.vec_env import TrafficJunctionVecEnv


def test_all_ids_make_what_they_say():
    levels = ["traffic-junction-easy", "traffic-junction-medium", "traffic-junction-hard"]
    games = ["convention-swap", "convention-watch-act", "convention-redraw"]
    assert registered_ids() == levels + games
    for env_id in games:
        # what they stand for is tested with the environment
        env, batched = make_parallel_env(env_id), make_batched_env(env_id, 3)
        assert isinstance(env, SwitchingConvention) and isinstance(batched, SwitchingConventionVecEnv)
        assert batched.config == env.config
    for env_id, n_cars in zip(levels, (5, 10, 20), strict=True):
        env = make_parallel_env(env_id)
        assert isinstance(env, TrafficJunction)
        assert env.config.level == env_id.rsplit("-", 1)[1]
        batched = make_batched_env(env_id, 3)
        assert isinstance(batched, TrafficJunctionVecEnv)
        assert batched.num_envs == 3
        assert batched.possible_agents == env.possible_agents == [f"car_{i}" for i in range(n_cars)]
        observation_spaces: Any = batched.observation_space
        action_spaces: Any = batched.action_space
        for agent in env.possible_agents:
            assert observation_spaces[agent] == env.observation_space(agent)
            assert action_spaces[agent] == env.action_space(agent)


def test_users_arguments_override_those_of_the_id():
    env = make_parallel_env("traffic-junction-easy", level="medium", arrival_rate=0.07)
    assert (env.config.level, env.core.arrival_rate) == ("medium", 0.07)
    batched = make_batched_env("traffic-junction-medium", 2, order="ic3net", reward="team")
    assert isinstance(batched, TrafficJunctionVecEnv)
    assert (batched.config.level, batched.config.order, batched.config.reward) == ("medium", "ic3net", "team")


def test_unknown_id_names_the_nearest_and_all():
    with pytest.raises(ValueError, match="Did you mean 'traffic-junction-medium'") as error:
        spec("trafic-junction-medum")
    assert all(env_id in str(error.value) for env_id in registered_ids())
    with pytest.raises(ValueError, match="Registered ids"):
        make_parallel_env("zzz")
    with pytest.raises(ValueError, match="Unknown environment id"):
        make_batched_env("zzz", 2)


def test_spec_without_batched_class_and_read_only_kwargs(monkeypatch):
    plain = EnvSpec("plain", "sb3_belief.envs.traffic_junction:TrafficJunction", {"level": "easy"})
    monkeypatch.setitem(registry_module._SPECS, "plain", plain)
    assert make_batched_env("plain", 2) is None
    assert make_parallel_env("plain").config.level == "easy"
    with pytest.raises(TypeError):
        plain.kwargs["level"] = "hard"  # type: ignore[index]


def test_importing_environments_loads_no_pygame_and_no_team():
    code = (
        "import sys; import sb3_belief.envs.registry; before = 'sb3_belief.team' in sys.modules;"
        "sys.modules.pop('sb3_belief', None); print(before, 'pygame' in sys.modules, 'sb3_belief.zoo' in sys.modules)"
    )
    # sb3_belief's own __init__ decides about the team room; what this room adds is what counts, so it is imported bare
    bare = (
        "import sys, types, pathlib; package = types.ModuleType('sb3_belief');"
        "package.__path__ = [str(pathlib.Path('sb3_belief').resolve())]; sys.modules['sb3_belief'] = package;"
    )
    result = subprocess.run([sys.executable, "-c", bare + code], capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["False", "False", "False"]
