"""Our QMIX mixer beside torchrl's, which has an environment of its own: make test-oracle."""

import json
import os
import subprocess
from pathlib import Path

import pytest
import torch as th

from sb3_belief.references.mixers import QMIX

#: Names another Python than that of ``make test-oracle``
VARIABLE = "ORACLE_PYTHON"
PYTHON = Path(os.environ.get(VARIABLE) or Path(__file__).parents[2] / ".venv-oracle" / "bin" / "python")
# Its layers, and ours
LAYERS = {"hyper_w_1": "w1.0", "hyper_w_final": "w2.0", "hyper_b_1": "b1", "V.0": "b2.0", "V.2": "b2.2"}


def test_equal_weights_give_equal_values(tmp_path):
    if not PYTHON.exists() or subprocess.run([PYTHON, "-c", "import torchrl"], capture_output=True).returncode:
        pytest.skip(f"torchrl is not installed in {PYTHON}: make test-oracle, or set {VARIABLE} to a Python that has it")
    mixer = QMIX(n_agents=4, n_actions=3, state_dim=7, embedding_dim=16, hypernet_dim=None).double()
    own = mixer.state_dict()
    weights = {f"{theirs}.{kind}": own[f"{ours}.{kind}"] for theirs, ours in LAYERS.items() for kind in ("weight", "bias")}
    assert len(weights) == len(own)
    # In double precision, in which only another formula makes a difference
    q, state = th.randn(50, 4, dtype=th.float64), th.randn(50, 7, dtype=th.float64)
    th.save({"weights": weights, "q": q, "state": state, "embedding_dim": 16}, tmp_path / "given.pt")
    script = Path(__file__).with_name("torchrl_qmix.py")
    done = subprocess.run([PYTHON, script, tmp_path / "given.pt"], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    with th.no_grad():
        found = mixer(q, q, th.zeros(50, 4, 3), state).squeeze(-1)
    assert found.tolist() == pytest.approx(json.loads(done.stdout), abs=1e-6)
