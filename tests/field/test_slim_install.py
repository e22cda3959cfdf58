"""A deployed agent needs SB3, PyTorch and Gymnasium: nothing else is imported for it, and nothing else need be installed."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import sb3_belief
from sb3_belief import belief_ppo

ROOT = Path(__file__).parents[2]
# What only training a team, masks, logs and the command line need
NOT_NEEDED = ["pettingzoo", "supersuit", "greenlet", "sb3_contrib", "tensorboard", "yaml", "tqdm", "rich"]

HIDE = f"""
from importlib.machinery import PathFinder

find = PathFinder.find_spec
PathFinder.find_spec = lambda name, *rest: None if name.partition(".")[0] in {NOT_NEEDED} else find(name, *rest)
"""


def run(code, *args, cwd=ROOT):
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    result = subprocess.run([sys.executable, "-c", code, *map(str, args)], cwd=cwd, env=env, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return result.stdout.split()


@pytest.mark.parametrize(
    "line",
    [
        "from sb3_belief import BeliefPPO",
        "from sb3_belief.belief_ppo import BeliefPPO, BeliefActorCriticPolicy, OthersPrediction",
        "from sb3_belief.baselines.iql import IQL",
        "from sb3_belief.baselines.dpiqn import DPIQN, DRPIQN",
    ],
)
def test_nothing_is_imported_that_an_agent_does_not_need(line):
    # SB3 imports tensorboard, tqdm and rich by itself where they are installed
    code = f"""
import sys, stable_baselines3
before = set(sys.modules)
{line}
print(*{{name.partition(".")[0] for name in set(sys.modules) - before}})
"""
    assert set(run(code)) & {*NOT_NEEDED, "sb3_contrib", "matplotlib", "pandas"} == set()


def test_the_package_alone_imports_nothing():
    code = "import sys, sb3_belief; print(sb3_belief.__version__, 'torch' in sys.modules, 'BeliefPPO' in dir(sb3_belief))"
    assert run(code) == [sb3_belief.__version__, "False", "True"]


SERVE = """
import sys
import numpy as np
from sb3_belief import BeliefPPO

model = BeliefPPO.load(sys.argv[1], device="cpu")
cues = np.arange(40) % 3
believed = []
for shift in range(2):
    model.policy.remember(cues, {"leader": (cues + shift) % 3})
    believed.append(model.policy.predict_others(cues).mean)
assert (believed[0] != believed[1]).any()
action, _ = model.predict(cues[:3], deterministic=True)
assert action.shape == (3,) and "pettingzoo" not in sys.modules
model.save("again.zip")
"""


def saved_agent(folder):
    """A team's file, and one agent taken out of it without this package."""
    env = sb3_belief.make_team_env("convention-swap", n_envs=2, seed=0, env_kwargs={"m": 3})
    team = sb3_belief.Team(sb3_belief.BeliefPPO, "BeliefPolicy", env, seed=0, n_steps=16, batch_size=16, history_length=40)
    team.learn(32).save(folder / "team.zip")
    with zipfile.ZipFile(folder / "team.zip") as archive:
        return archive.extract("agents/follower.zip", folder)


def test_an_agent_of_a_team_serves_without_the_rest_installed(tmp_path):
    run(HIDE + SERVE, saved_agent(tmp_path), cwd=tmp_path)
    assert (tmp_path / "again.zip").exists()


def test_an_agent_learns_without_the_rest_installed(tmp_path):
    code = """
import gymnasium as gym
from sb3_belief import BeliefPPO

BeliefPPO("BeliefPolicy", gym.make("CartPole-v1"), n_steps=16, batch_size=16, belief="none").learn(16)
"""
    run(HIDE + code)


def test_environments_of_many_agents_are_still_refused():
    code = """
from sb3_belief import BeliefPPO
from sb3_belief.envs import TrafficJunction

try:
    BeliefPPO("BeliefPolicy", TrafficJunction())
except TypeError as error:
    print("many" if "environment of many" in str(error) else error)
"""
    assert run(code) == ["many"]


@pytest.mark.parametrize("package", [sb3_belief, belief_ppo])
def test_all_public_names_are_there(package):
    assert {*package.__all__} <= {*dir(package)}
    assert all(getattr(package, name) is not None for name in package.__all__)
    with pytest.raises(AttributeError, match="has no attribute 'Belief'"):
        package.Belief  # noqa: B018


def test_packages_are_reached_as_attributes():
    assert run("import sb3_belief; print(sb3_belief.team.Team is sb3_belief.Team, sb3_belief.envs.__name__)") == [
        "True",
        "sb3_belief.envs",
    ]


def test_a_command_says_what_an_install_for_serving_lacks():
    script = (
        "import sys; sys.modules['sb3_contrib'] = None; from sb3_belief.cli.main import main; sys.exit(main(['export', 'x']))"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert ended.returncode == 2 and ended.stderr.startswith("Refused: this command needs sb3_contrib, which"), ended.stderr
