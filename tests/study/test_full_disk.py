"""A disk that is full costs the run that writes, and nothing that has finished."""

import contextlib
import os
import subprocess
import sys
import tempfile

import pytest

from sb3_belief.cli.main import main
from sb3_belief.report.episodes import read_episodes_table
from sb3_belief.study.cell_record import all_cells
from sb3_belief.zoo.endings import SignalCheck
from tests.study.test_study_folder import in_process  # noqa: F401
from tests.study.tiny import statuses, write


@pytest.fixture
def small_disk(tmp_path):
    folder = tmp_path / "disk"
    folder.mkdir()
    if sys.platform != "linux" or os.geteuid() != 0:
        pytest.skip("only root may mount a small disk (Linux)")
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=32m", "tmpfs", str(folder)], capture_output=True)
    if mounted.returncode:
        pytest.skip(f"a small disk cannot be mounted here: {mounted.stderr.decode().strip()}")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=False)


def fill(path):
    with contextlib.suppress(OSError), open(path, "wb", buffering=0) as file:
        while True:
            file.write(b"0" * 4096)


def test_a_full_disk_costs_nothing_that_has_finished(tmp_path, small_disk, in_process, capsys, monkeypatch):  # noqa: F811
    # Where a team is saved that has no room in its folder
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    file = write(tmp_path, seeds=1)
    words = ["study", str(file), "-f", str(small_disk)]
    assert main(words) == 0
    folder = small_disk / "tiny"
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    write(tmp_path, seeds=2)
    fill(small_disk / "filler")
    # Said before anything starts
    assert main(words) == 2
    assert "cannot write in the folder" in capsys.readouterr().err
    # Full while a run is trained
    (small_disk / "filler").unlink()
    real = SignalCheck._on_step

    def filled(self):
        if self.num_timesteps >= 240:
            fill(small_disk / "filler")
        return real(self)

    monkeypatch.setattr(SignalCheck, "_on_step", filled)
    assert main(words) == 1
    error = capsys.readouterr().err
    assert "/seed_1: " in error and "episodes.parquet cannot be written: No space left on device" in error
    monkeypatch.setattr(SignalCheck, "_on_step", real)
    one, other = all_cells(folder)
    assert one.read()["status"] == "finished" and other.read()["status"] != "finished"
    assert all(path.read_bytes() == content for path, content in before.items() if path.name != "study.yml")
    # With room again it goes on
    (small_disk / "filler").unlink()
    assert main([*words, "--retry"]) == 0
    assert set(statuses(folder).values()) == {"finished"}
    assert read_episodes_table(folder / "episodes.parquet").num_rows == 64
