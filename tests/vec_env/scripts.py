"""Scripts in processes of their own, and who is left of these and of what they have started."""

import os
import subprocess
import sys
import time
from pathlib import Path
from textwrap import dedent

import pytest

#: What a script with an environment in workers begins with
WITH_WORKERS = """
import multiprocessing
from functools import partial
from sb3_belief.team import make_team_env, Team
from tests.team.toy_envs import ToyEnv
from tests.vec_env.faulty_envs import *
multiprocessing.set_forkserver_preload(["tests.vec_env.faulty_envs", "sb3_belief.team"])
"""
#: The same if nobody learns in a worker: they need not import what optimizers do
WITH_COPIES = f"""{WITH_WORKERS}
from sb3_belief.common import processes
processes.WORKERS_NEED.remove("torch._dynamo")
"""


def run_script(body, tmp_path, marker="", head=WITH_COPIES):
    """Run a script that begins with some imports."""
    path = tmp_path / "script.py"
    path.write_text(f"import os, sys, time, signal\n{head}\n{dedent(body)}")
    root = str(Path(__file__).parents[2])
    env = {**os.environ, "PYTHONPATH": root, "OMP_NUM_THREADS": "1", "FAULTS_TEST": marker}
    return subprocess.Popen([sys.executable, str(path)], stdout=subprocess.PIPE, text=True, env=env)


def marked(marker):
    """Return the processes that have a marker in their environment, except those that have ended and are not yet forgotten."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            ended = (folder / "stat").read_text().rpartition(")")[2].split()[0] == "Z"
            if f"FAULTS_TEST={marker}".encode() in (folder / "environ").read_bytes().split(b"\0") and not ended:
                found.append((int(folder.name), (folder / "cmdline").read_bytes()[:60]))
        except OSError:
            continue
    return found


def gone_within(seconds, marker):
    """Return the processes that are still there after a while."""
    deadline = time.monotonic() + seconds
    while (found := marked(marker)) and time.monotonic() < deadline:
        time.sleep(0.05)
    return found


LINUX = pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="looks at /proc")
