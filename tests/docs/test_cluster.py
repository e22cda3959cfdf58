"""The array script of docs/cluster.md trains in parts, and its containers copy what the package is built from."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from sb3_belief.team.checkpoint import read_team

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "cluster.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_script_goes_on_where_it_was_interrupted(tmp_path):
    (script,) = re.findall(r"```bash\n(#!/bin/bash\n.*?)```", TEXT, re.DOTALL)
    script = re.sub(r"^PARTS=.*", "PARTS=2", script, flags=re.MULTILINE)
    script = re.sub(r"^STEPS=.*", "STEPS=1280", script, flags=re.MULTILINE)
    script = script.replace("traffic-junction-medium", "traffic-junction-easy")
    # A cluster has the package's command in its path
    env = {**os.environ, "SLURM_ARRAY_TASK_ID": "3", "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    for file in ("train.py", "sb3_belief", "zoo_configs"):
        (tmp_path / file).symlink_to(ROOT / file)

    def run():
        result = subprocess.run(["bash", "-c", script], cwd=tmp_path, env=env, capture_output=True, text=True)
        assert result.returncode == 0, result.stderr
        return sorted(path.relative_to(tmp_path / "logs" / "seed_3") for path in (tmp_path / "logs").rglob("team.zip"))

    parts = [Path(f"part_{part}/belief_ppo/traffic-junction-easy_1/team.zip") for part in (1, 2)]
    assert run() == parts
    written = {part: (tmp_path / "logs" / "seed_3" / part).stat().st_mtime_ns for part in parts}
    # The second part is done anew, the first is not
    shutil.rmtree(tmp_path / "logs" / "seed_3" / "part_2")
    assert run() == parts
    first, second = (tmp_path / "logs" / "seed_3" / part for part in parts)
    assert first.stat().st_mtime_ns == written[parts[0]] and second.stat().st_mtime_ns > written[parts[1]]
    assert read_team(second).manifest["num_timesteps"] == 2 * read_team(first).manifest["num_timesteps"]


def test_containers_copy_what_there_is():
    copied = re.findall(r"^COPY (.*) \S+$", TEXT, re.MULTILINE)
    docker = [name for line in copied for name in line.split()]
    apptainer = re.findall(r"^    (\S+) /opt/sb3-belief/$", TEXT, re.MULTILINE)
    assert docker == apptainer and {"setup.cfg", "pyproject.toml", "constraints.txt", "sb3_belief", "zoo_configs"} <= {*docker}
    assert all((ROOT / name).exists() for name in docker)
    # What the build reads
    named = re.findall(r"= file: (\S+)|^license_files = (\S+)", (ROOT / "setup.cfg").read_text(), re.MULTILINE)
    assert {name.partition("/")[0] for pair in named for name in pair if name} <= {*docker}
