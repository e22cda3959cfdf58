"""
Files of earlier versions load, predict what they predicted, and go on learning.

They are pickles, and so load only if they are trusted.
"""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_belief import MaskableBeliefPPO, Team, make_team_env
from sb3_belief.cli.main import main as command
from tests.compatibility.write_files import ENV_ID, RUN_ENV_ID, outputs

DATA = Path(__file__).parent / "data"
EXPECTED = json.loads((DATA / "expected.json").read_text())


def assert_same(found: dict, expected: dict) -> None:
    assert found.keys() == expected.keys()
    assert found["actions"] == expected["actions"]
    for name in found:
        # To the bit on one machine; another's matrix products may differ in the last places
        for part, wanted in zip(found[name], expected[name], strict=True):
            np.testing.assert_allclose(part, wanted, rtol=1e-5, atol=1e-6, err_msg=name)


def weights(model) -> th.Tensor:
    return th.nn.utils.parameters_to_vector(model.policy.parameters()).detach().clone()


def test_a_team_loads_predicts_the_same_and_goes_on_learning():
    env = make_team_env(ENV_ID, n_envs=2, seed=1)
    with pytest.raises(ValueError, match=r"team.zip is of an earlier version .* a pickle can run any code"):
        Team.load(DATA / "team.zip", env=env)
    team = Team.load(DATA / "team.zip", env=env, trust_pickle=True)
    assert team.num_timesteps == 64 and team.normalize is True
    model: Any
    for agent, model in team.agents.items():
        assert_same(outputs(model), EXPECTED["team"][agent])
        # The history came along, and so did the statistics of the normalisation
        assert bool(model.policy.history.valid.all())
        assert model.get_vec_normalize_env().obs_rms.count > 64
    before = {agent: weights(model) for agent, model in team.agents.items()}
    team.learn(64, reset_num_timesteps=False)
    assert team.num_timesteps == 128
    for agent, model in team.agents.items():
        after = weights(model)
        assert th.isfinite(after).all() and not th.equal(after, before[agent])


def test_an_agent_loads_without_the_others():
    with pytest.raises(ValueError, match=r"agent.zip has been written by .* an earlier version .* a pickle can run any code"):
        MaskableBeliefPPO.load(DATA / "agent.zip")
    model = MaskableBeliefPPO.load(DATA / "agent.zip", trust_pickle=True)
    assert_same(outputs(model), EXPECTED["agent"]["car_1"])
    assert model.num_timesteps == 64


def test_a_run_folder_is_gone_on_with(tmp_path):
    folder = shutil.copytree(DATA / "results", tmp_path / "results")
    first, second = (folder / "belief_ppo" / f"{RUN_ENV_ID}_{number}" for number in (1, 2))
    resumed = ["train", "--env", RUN_ENV_ID, "-i", str(first), "-n", "64", "-f", str(folder), "--eval-freq", "-1"]
    assert command(resumed) == 2 and not second.exists()
    assert command([*resumed, "--trust"]) == 0
    assert json.loads((second / "run.json").read_text())["status"] == "finished"
    before, after = Team.load(first / "team.zip", trust_pickle=True), Team.load(second / "team.zip")
    assert (before.num_timesteps, after.num_timesteps) == (64, 128)
    assert not th.equal(weights(before.agents["follower"]), weights(after.agents["follower"]))
    assert Team.load(first / "best_model.zip", trust_pickle=True).possible_agents == ["follower"]
