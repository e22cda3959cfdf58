"""docs/reliability.md: its program does what it says, and its flags, statuses and names are those of the code."""

import os
import re
import subprocess
import sys
from pathlib import Path

from sb3_belief.cli.main import make_parser

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "reliability.md").read_text(encoding="utf-8")


def test_the_program_resumes_exactly(tmp_path):
    (code,) = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    (tmp_path / "resumes.py").write_text(code)
    result = subprocess.run(
        [sys.executable, "resumes.py"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout == "True\n"
    assert {path.name for path in (tmp_path / "checkpoints").iterdir()} == {"team_320_steps.zip", "team_480_steps.zip"}


def test_commands_and_flags_are_accepted():
    parser = make_parser()
    commands = re.findall(r"^python train\.py (.*?)(?:  +#.*)?$", TEXT, re.MULTILINE)
    assert len(commands) == 2
    for command in commands:
        parser.parse_args(["train", *command.split()])
    shown = set(re.findall(r"`(--[a-z-]+)(?: [^`]*)?`", TEXT)) | set(re.findall(r"`[^`]*? (--[a-z-]+)[^`]*`", TEXT))
    with_values = {"--step-timeout": "60s", "--restart-workers": "3", "--save-every": "10m", "--save-freq": "100"}
    with_values |= {"--jobs": "2", "--until": "100", "--resume": "run", "--allow-package": "my", "--vec-env": "subproc"}
    with_values |= {"--on-nan": "skip"}
    assert {"--resume", "--until", "--trust", "--step-timeout", "--restart-workers"} <= shown
    for flag in shown:
        parser.parse_args(["train", flag, *([with_values[flag]] if flag in with_values else [])])
