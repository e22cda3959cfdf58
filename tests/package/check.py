"""
What ``make package`` checks of the built distributions: what they hold, and that the wheel works where there is no checkout.

    python -m tests.package.check dist .venv-package
"""

import os
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from pathlib import Path
from typing import Any

from sb3_belief import BeliefPPO, Team, make_team_env

ROOT = Path(__file__).parents[2]
IN_SDIST = (
    "tests/field/test_slim_install.py",
    "tests/compatibility/data/team.zip",
    "docs/deploy.md",
    "examples/belief_team.py",
    "zoo_configs/belief_ppo.yml",
    "constraints.txt",
    "constraints-smax.txt",
    "CHANGELOG.md",
    "LICENSE",
    "Makefile",
    ".ci/run",
)
SERVE = """
import sys
import numpy as np
import sb3_belief
from sb3_belief import BeliefPPO

model = BeliefPPO.load(sys.argv[1], device="cpu")
cues = np.arange(40) % 3
action, _ = model.predict(cues, deterministic=True)
before = model.policy.predict_others(cues)
model.policy.remember(cues, {"leader": (cues + 1) % 3})
assert action.shape == (40,) and (model.policy.predict_others(cues).mean != before.mean).any()
print(sb3_belief.__file__)
"""
NOT_INSTALLED = (
    "import importlib.util as u; print([n for n in 'pettingzoo supersuit greenlet sb3_contrib'.split() if u.find_spec(n)])"
)


def main(dist: Path, venv: Path) -> None:
    """Check the distributions in a folder, with a new virtual environment for the wheel."""
    (sdist,), (wheel,) = dist.glob("*.tar.gz"), dist.glob("*.whl")
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    missing = [name for name in IN_SDIST if name not in names]
    unwanted = [name for name in names if "__pycache__" in name or name.startswith((".venv", "docs/_build", "logs/"))]
    assert not missing and not unwanted, f"{sdist.name} lacks {missing} and has {unwanted[:3]}"

    with tempfile.TemporaryDirectory() as folder:
        python, elsewhere = venv.resolve() / "bin" / "python", Path(folder)
        pip = [python, "-m", "pip", "install", "--no-compile", "--quiet", "-c", ROOT / "constraints.txt"]

        # An agent is served by what an agent needs
        run([*pip, "stable-baselines3", "torch", "gymnasium"], elsewhere)
        run([*pip, "--no-deps", wheel.resolve()], elsewhere)
        assert run([python, "-c", NOT_INSTALLED], elsewhere).strip() == "[]"
        place = run([python, "-c", SERVE, save_agent(elsewhere)], elsewhere)
        assert str(venv.resolve()) in place, f"the check has used {place}"

        # A team is trained by all of it, with the settings that the wheel brought
        run([*pip, wheel.resolve()], elsewhere)
        run([python, "-m", "pip", "check"], elsewhere)
        options = "--env traffic-junction-easy -n 128 --eval-freq -1 -params n_envs:2 n_steps:32 batch_size:64".split()
        run([venv.resolve() / "bin" / "sb3-belief", "train", *options], elsewhere)
        assert (elsewhere / "logs" / "belief_ppo" / "traffic-junction-easy_1" / "team.zip").exists()
    print(f"{sdist.name} and {wheel.name} are whole, and the wheel serves an agent and trains a team")


def save_agent(folder: Path) -> Path:
    """Train and save an agent, here."""
    env = make_team_env("convention-swap", n_envs=2, seed=0, env_kwargs={"m": 3})
    team = Team(BeliefPPO, "BeliefPolicy", env, seed=0, n_steps=16, batch_size=16, history_length=40).learn(32)
    team.save(folder / "team.zip")
    with zipfile.ZipFile(folder / "team.zip") as archive:
        return Path(archive.extract("agents/follower.zip", folder))


def run(command: list[Any], cwd: Path) -> str:
    """Run a command outside of the checkout, without its sources, and return what it prints."""
    env = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    result = subprocess.run([str(word) for word in command], cwd=cwd, env=env, capture_output=True, text=True)
    if result.returncode:
        sys.exit(f"{' '.join(map(str, command[:6]))} ... failed:\n{result.stdout}{result.stderr}")
    return result.stdout


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
