"""The zip of one model of any algorithm of ours is read without running anything of whoever made it."""

from functools import partial
from typing import Any

import cloudpickle
import numpy as np
import pytest

from sb3_belief.team import AgentEnv
from sb3_belief.zoo.names import ALGOS
from tests.baselines.test_decentralised import Masked, make_team
from tests.references.test_mappo import Stateful
from tests.team.helpers import parameters

OURS = [name for name, algo in ALGOS.items() if algo.path.startswith("sb3_belief.")]
# One whose agents are the environment's own, and see what they see there
PARTNERS = [name for name in OURS if not ALGOS[name].adapter and name != "drpiqn"]


def env_of(name):
    return Masked if "maskable" in name else Stateful


@pytest.fixture
def no_pickles(monkeypatch):
    """Reading what SB3 pickles fails."""

    def refuse(*args, **kwargs):
        raise AssertionError("A pickle was read")

    monkeypatch.setattr(cloudpickle, "loads", refuse)


@pytest.mark.parametrize("name", OURS)
def test_the_zip_of_one_model(name, tmp_path, no_pickles):
    model: Any = next(iter(make_team(name).learn(32).agents.values()))
    model.save(tmp_path / "model.zip")
    again = type(model).load(tmp_path / "model.zip", device="cpu")
    assert all(np.array_equal(one, other) for one, other in zip(parameters(again), parameters(model), strict=True))
    assert again.num_timesteps == model.num_timesteps >= 32 and again.learning_rate == model.learning_rate


@pytest.mark.parametrize("name", PARTNERS)
def test_one_zip_is_a_partner(name, tmp_path):
    """As a path: its algorithm is found in the file, and its masks are given to it."""
    team = make_team(name).learn(32)
    model = team.agents["agent_1"]
    model.save(tmp_path / "one.zip")
    own = team.get_env().possible_agents[0]
    acted = {}
    for kind, partner in (("path", str(tmp_path / "one.zip")), ("model", model)):
        env = AgentEnv(partial(env_of(name)), own, {"agent_1": partner}, deterministic=True)
        env.reset(seed=0)
        acted[kind] = [env.step(0)[4]["others_actions"].tolist() for _ in range(6)]
    assert acted["path"] == acted["model"] and np.sum(acted["path"]) > 0
