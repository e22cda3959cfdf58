"""
A study on a Ray cluster, of which a node is lost.

Ray is no requirement of the tests: ``pip install 'sb3-belief[ray]'`` has these run.
"""

import os
import time
from importlib.util import find_spec
from pathlib import Path

import pytest

import sb3_belief
from sb3_belief.report.episodes import read_episodes_table
from sb3_belief.study.cell_record import all_cells, steps_done
from sb3_belief.study.ray_engine import TOKEN_FILE, run_cell_in_task
from tests.study.tiny import TINY, prepared, record, start, write

needs_ray = pytest.mark.skipif(find_spec("ray") is None, reason="needs ray: pip install 'sb3-belief[ray]'")
LONGER = {"seeds": 2, "n_timesteps": 4000, "evaluation": {**TINY["evaluation"], "every": 800}}


def test_a_node_without_the_folder_says_so(tmp_path):
    (cell,) = prepared(tmp_path)
    folder = tmp_path / "logs" / "tiny"
    assert "does not see the folder" in str(run_cell_in_task(str(cell.folder), str(folder), "token", ()))
    # Another folder of the same path
    (folder / TOKEN_FILE).write_text("of another study")
    assert "all nodes must share it" in str(run_cell_in_task(str(cell.folder), str(folder), "token", ()))
    assert record(cell)["attempts"] == 0


@pytest.fixture
def cluster(monkeypatch):
    """A head without room for runs, and two nodes with room for one each."""
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("PYTHONPATH", str(Path(sb3_belief.__file__).parents[1]))
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    nodes = [made.add_node(num_cpus=1) for _ in range(2)]
    yield made, nodes
    made.shutdown()


@needs_ray
@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="clusters of one machine")
def test_a_study_on_a_cluster_outlives_a_node(tmp_path, cluster):
    undisturbed = start(write(tmp_path, "undisturbed.yml", **LONGER), "-f", tmp_path / "undisturbed", "--jobs", "2")
    out, _ = undisturbed.communicate(timeout=280)
    assert undisturbed.returncode == 0, out
    made, nodes = cluster
    folder = tmp_path / "logs"
    process = start(write(tmp_path, **LONGER), "-f", folder, "--engine", "ray", "--address", made.address)
    cells: list = []
    deadline = time.monotonic() + 120
    # Both nodes are in the middle of a run
    while time.monotonic() < deadline and process.poll() is None:
        cells = list(all_cells(folder / "tiny"))
        if len(cells) == 2 and all(record(cell)["status"] == "running" and steps_done(cell, record(cell)) for cell in cells):
            break
        time.sleep(0.05)
    assert [record(cell)["status"] for cell in cells] == ["running", "running"]
    made.remove_node(nodes[0], allow_graceful=False)
    out, _ = process.communicate(timeout=280)
    assert process.returncode == 0, out
    # The lost run went on from its checkpoint, once, and the other was not disturbed
    assert sorted(record(cell)["attempts"] for cell in cells) == [1, 2]
    table = read_episodes_table(folder / "tiny" / "episodes.parquet")
    assert table.equals(read_episodes_table(tmp_path / "undisturbed" / "tiny" / "episodes.parquet"))
