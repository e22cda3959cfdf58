"""The array script of docs/cluster.md goes on after a signal, and its containers copy what the package is built from."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sb3_belief.team.checkpoint import read_team

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "cluster.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_script_goes_on_where_it_was_interrupted(tmp_path):
    (script,) = re.findall(r"```bash\n(#!/bin/bash\n.*?)```", TEXT, re.DOTALL)
    script = re.sub(r"^STEPS=.*", "STEPS=12800", script, flags=re.MULTILINE)
    # Small enough for seconds, and with something to go on from
    script = script.replace("traffic-junction-medium", "traffic-junction-easy").replace(
        "--eval-freq -1", "--eval-freq -1 --save-freq 4096"
    )
    bin_ = tmp_path / "bin"
    bin_.mkdir()
    # A cluster has the package's command in its path
    (bin_ / "srun").write_text('#!/bin/bash\nexec "$@"\n')
    (bin_ / "scontrol").write_text(f'#!/bin/bash\necho "$@" >> {tmp_path}/requeued\n')
    for file in bin_.iterdir():
        file.chmod(0o755)
    path = f"{bin_}:{Path(sys.executable).parent}:{os.environ['PATH']}"
    env = {**os.environ, "SLURM_ARRAY_TASK_ID": "3", "SLURM_JOB_ID": "17", "PATH": path}
    for file in ("train.py", "sb3_belief", "zoo_configs"):
        (tmp_path / file).symlink_to(ROOT / file)
    run = tmp_path / "logs" / "seed_3" / "belief_ppo" / "traffic-junction-easy_1"
    process = subprocess.Popen(["bash", "-c", script], cwd=tmp_path, env=env, text=True, start_new_session=True)
    deadline = time.monotonic() + 120
    while not list(run.glob("checkpoints/*.zip")) and time.monotonic() < deadline:
        time.sleep(0.05)
    # As a scheduler does: to all processes of the step
    pid = json.loads("[" + (run / ".lock").read_text().split()[1] + "]")[0]
    os.kill(pid, signal.SIGTERM)
    assert process.wait(120) == 143
    assert (tmp_path / "requeued").read_text() == "requeue 17\n"
    assert json.loads((run / "run.json").read_text())["status"] == "interrupted"
    for _ in range(2):
        result = subprocess.run(["bash", "-c", script], cwd=tmp_path, env=env, capture_output=True, text=True)
        assert result.returncode == 0, result.stderr
        assert json.loads((run / "run.json").read_text())["status"] == "finished"
    assert read_team(run / "team.zip").manifest["num_timesteps"] >= 12800


def test_containers_copy_what_there_is():
    copied = re.findall(r"^COPY (.*) \S+$", TEXT, re.MULTILINE)
    docker = [name for line in copied for name in line.split()]
    apptainer = re.findall(r"^    (\S+) /opt/sb3-belief/$", TEXT, re.MULTILINE)
    assert docker == apptainer and {"setup.cfg", "pyproject.toml", "constraints.txt", "sb3_belief", "zoo_configs"} <= {*docker}
    assert all((ROOT / name).exists() for name in docker)
    # What the build reads
    named = re.findall(r"= file: (\S+)|^license_files = (\S+)", (ROOT / "setup.cfg").read_text(), re.MULTILINE)
    assert {name.partition("/")[0] for pair in named for name in pair if name} <= {*docker}
