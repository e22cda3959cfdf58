"""Fixtures of the tests of SMAX."""

import pytest

from tests.envs.adapters.smax.helpers import make_batched


@pytest.fixture(scope="module")
def mixed():
    """Return four battles of 2s3z, made once per file for the tests that leave them usable for the next one."""
    return make_batched("2s3z", 4)
