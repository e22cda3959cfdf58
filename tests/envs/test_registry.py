"""Ids of environments: the package's own, those of suites, those of users, and what happens if a package is missing."""

import re
import subprocess
import sys
from importlib import metadata
from typing import Any

import numpy as np
import pytest

from sb3_belief.envs import (
    SUITES,
    EnvSpec,
    SwitchingConvention,
    TrafficJunction,
    make_batched_env,
    make_parallel_env,
    register,
    registered_ids,
    spec,
    suites,
)
from sb3_belief.envs import registry as registry_module
from sb3_belief.envs.switching_convention.vec_env import SwitchingConventionVecEnv
from sb3_belief.envs.traffic_junction.vec_env import TrafficJunctionVecEnv
from sb3_belief.team import make_team_env
from tests.team.toy_envs import ToyEnv


def test_all_ids_make_what_they_say():
    levels = ["traffic-junction-easy", "traffic-junction-medium", "traffic-junction-hard"]
    games = ["convention-swap", "convention-watch-act", "convention-redraw"]
    aisles = ["aisle-sides", "aisle-sides-kinds"]
    cultures = ["junction-cultures-easy", "junction-cultures-medium", "junction-cultures-orders"]
    tasks = ["convention-episode", "foreign-speaker", "picker", "lbf-heuristics"]
    tables = ["climbing", "qtran-matrix", "qplex-matrix", "coordination"]
    small = ["penalty", "permutation", "two-step", "cues", "hidden-offset", "levers"]
    assert registered_ids() == levels + games + aisles + cultures + tasks + tables + small
    for env_id in games:
        # The arguments behind the ids are tested with the environment
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
    with pytest.raises(ValueError, match=r"Did you mean .*'smax/'.*Suites: .*smax/<name>"):
        spec("smx/3m")
    with pytest.raises(ValueError, match=r"'mpe/' lacks the environment's name; its ids are 'mpe/<name>': .*simple_spread_v3"):
        spec("mpe/")


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
    # sb3_belief/__init__.py imports the team package. An empty package takes its place, since only envs' own imports count
    bare = (
        "import sys, types, pathlib; package = types.ModuleType('sb3_belief');"
        "package.__path__ = [str(pathlib.Path('sb3_belief').resolve())]; sys.modules['sb3_belief'] = package;"
    )
    result = subprocess.run([sys.executable, "-c", bare + code], capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["False", "False", "False"]


@pytest.fixture
def own_registry(monkeypatch):
    """Give the test a registry of its own, so that its registrations end with it."""
    monkeypatch.setattr(registry_module, "_SPECS", dict(registry_module._SPECS))


def test_looking_at_the_registry_imports_no_package():
    roots = sorted({module.partition(".")[0] for suite in SUITES.values() for module in suite.modules} - {"pettingzoo"})
    code = (
        "import sys; from sb3_belief.envs import registry\n"
        "for suite in registry.SUITES.values(): registry.spec(f'{suite.name}/x'); suite.missing()\n"
        f"print([name for name in {roots} if name in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


@pytest.mark.parametrize("suite", SUITES.values(), ids=lambda suite: suite.name)
def test_a_missing_package_is_named_with_the_line_that_installs_it(suite, monkeypatch):
    monkeypatch.setattr(suites, "is_installed", lambda module: False)
    makers: list[Any] = [make_parallel_env, make_team_env]
    if suite.batched is not None:
        makers.append(lambda id: make_batched_env(id, 2))
    for make in makers:
        with pytest.raises(ModuleNotFoundError, match=re.escape(suite.install)) as error:
            make(f"{suite.name}/3m")
        assert error.value.name == suite.modules[0] and suite.note in str(error.value)


def test_the_missing_smac_warns_of_the_other_project(monkeypatch):
    monkeypatch.setattr(suites, "is_installed", lambda module: False)
    with pytest.raises(ModuleNotFoundError, match="Not 'pip install smac', which installs another project"):
        make_parallel_env("smac/3m")


def test_the_other_project_called_smac_is_not_taken_for_it(tmp_path, monkeypatch):
    (tmp_path / "smac").mkdir()
    (tmp_path / "smac" / "__init__.py").write_text("raise RuntimeError('imported')\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert suites.is_installed("smac") and not suites.is_installed("smac.env.starcraft2")
    (tmp_path / "smac" / "env" / "starcraft2").mkdir(parents=True)
    for folder in ("env", "env/starcraft2"):
        (tmp_path / "smac" / folder / "__init__.py").touch()
    assert suites.is_installed("smac.env.starcraft2") and "smac" not in sys.modules


def test_a_module_and_a_callable_are_an_id():
    team_env = make_team_env("tests.team.toy_envs:ToyEnv", n_envs=2, env_kwargs={"n_agents": 3, "limit": 4})
    assert team_env.possible_agents == ["agent_0", "agent_1", "agent_2"] and team_env.reset()["agent_0"].shape == (2, 2)
    assert make_batched_env("tests.team.toy_envs:ToyEnv", 2) is None


@pytest.mark.parametrize(
    ("id", "message"),
    [
        ("tests.team.toy_envs:NoEnv", "'NoEnv' of the module 'tests.team.toy_envs', which cannot be imported: .*NoEnv"),
        ("no_such_module:make", "cannot be imported: No module named 'no_such_module'"),
        ("tests.team.helpers:PPO_KWARGS", "is a dict, not a callable"),
        ("os;exit():x", "Unknown environment id"),
    ],
)
def test_a_module_or_callable_that_is_none(id, message):
    with pytest.raises(ValueError, match=message):
        make_parallel_env(id)


def test_users_register_theirs_with_a_decorator(own_registry):
    def define(limit):
        @register("my/toy-2", kwargs={"n_agents": 4})
        class MyToy(ToyEnv):
            default = limit

        return MyToy

    first = define(3)
    assert registered_ids()[-1] == "my/toy-2"
    env = make_parallel_env("my/toy-2", limit=5)
    assert type(env) is first and (len(env.possible_agents), env.limit) == (4, 5)
    # A class may be registered again, as happens when a notebook's cell is run again
    assert type(make_parallel_env("my/toy-2")) is not define(4)
    assert make_parallel_env("my/toy-2").default == 4
    for taken in ("my/toy-2", "traffic-junction-easy"):
        with pytest.raises(ValueError, match=f"The id '{taken}' is another environment's already"):
            register(taken)(ToyEnv)


@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_what_a_user_registered_makes_a_team(own_registry, vec_env):
    # A worker process does not have what was registered in this one
    register("mine")(lambda limit=7: ToyEnv(2, limit))
    env = make_team_env("mine", n_envs=2, vec_env=vec_env, env_kwargs={"limit": 1})
    env.reset()
    assert env.step({agent: np.zeros(2, int) for agent in env.possible_agents})[2].tolist() == [True, True]
    env.close()


@pytest.mark.parametrize(
    ("id", "message"),
    [
        ("smax/mine", "belongs to the suite 'smax'"),
        ("mpe", "belongs to the suite 'mpe'"),
        ("", "cannot be an id"),
        ("a:b", "cannot be an id"),
        ("../a", "cannot be an id"),
    ],
)
def test_ids_that_cannot_be_registered(id, message, own_registry):
    with pytest.raises(ValueError, match=message):
        register(id)
    assert id not in registered_ids()


def test_only_what_can_be_called_is_registered(own_registry):
    with pytest.raises(TypeError, match="got ToyEnv"):
        register("mine")(ToyEnv())


def test_installed_packages_register_theirs_by_entry_points(monkeypatch, own_registry):
    points = [
        metadata.EntryPoint(name, value, registry_module.ENTRY_POINT_GROUP)
        for name, value in [
            ("their-toy", "tests.team.toy_envs:ToyEnv"),
            ("lbf/mine", "tests.team.toy_envs:ToyEnv"),
            ("traffic-junction-easy", "tests.team.toy_envs:ToyEnv"),
            ("broken", "tests.team.toy_envs"),
        ]
    ]
    monkeypatch.setattr(registry_module.metadata, "entry_points", lambda group: points)
    registry_module._installed_specs.cache_clear()
    try:
        with pytest.warns(UserWarning) as warned:
            assert registered_ids()[-1] == "their-toy"
        assert [str(warning.message).split("'")[1] for warning in warned] == ["lbf/mine", "traffic-junction-easy", "broken"]
        assert isinstance(make_parallel_env("their-toy"), ToyEnv)
        assert isinstance(make_parallel_env("traffic-junction-easy"), TrafficJunction)
    finally:
        registry_module._installed_specs.cache_clear()
