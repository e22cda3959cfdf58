"""Seeded runs end with the parameters that an earlier version ended with."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.compatibility.seeded_runs import RUNS

RECORDED = json.loads((Path(__file__).parent / "data" / "seeded_runs.json").read_text())


def test_all_runs_are_recorded():
    assert RECORDED.keys() == RUNS.keys()


@pytest.mark.parametrize("name", RUNS)
def test_a_seeded_run_is_as_recorded(name):
    found, expected = RUNS[name](), RECORDED[name]
    assert found.keys() == expected.keys()
    for agent, values in found.items():
        # To the last digit on the machine that recorded them; another one's matrix products may round differently, which an
        # update amplifies
        np.testing.assert_allclose(values, expected[agent], rtol=1e-4, err_msg=agent)
