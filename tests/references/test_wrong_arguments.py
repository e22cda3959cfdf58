"""Numbers that joint learners cannot work with are refused where they are given, not when they are first used."""

from typing import Any

import pytest

from sb3_belief.references.factorisation import ValueFactorisation
from sb3_belief.references.maddpg import MADDPG
from sb3_belief.references.rode import RODE
from tests.references.counting_team import joint_env

POLICIES = {RODE: "RodePolicy", MADDPG: "MaddpgPolicy", ValueFactorisation: "FactorisedPolicy"}


@pytest.mark.parametrize(
    ("algorithm", "kwargs", "message"),
    [
        (RODE, {"policy_kwargs": {"n_roles": 2, "role_interval": 0}}, "role_interval=0 must be an integer >= 1"),
        (RODE, {"policy_kwargs": {"n_roles": 2, "embedding_dim": 0}}, "embedding_dim=0 must be an integer >= 1"),
        (RODE, {"policy_kwargs": {"n_roles": 2, "hidden_dim": 0}}, "hidden_dim=0 must be an integer >= 1"),
        (ValueFactorisation, {"max_grad_norm": -1.0}, "max_grad_norm=-1.0 must be a number above 0"),
        (ValueFactorisation, {"policy_kwargs": {"mixer_kwargs": {"embedding_dim": 0}}}, "embedding_dim=0 must be an integer"),
        (MADDPG, {"policy_kwargs": {"temperature": 0.0}}, "temperature=0.0 must be a number above 0"),
        (MADDPG, {"policy_kwargs": {"temperature": float("nan")}}, "temperature=nan must be a number above 0"),
        (MADDPG, {"train_freq": 0}, "train_freq=0 must be an integer >= 1"),
        (MADDPG, {"learning_starts": -1}, "learning_starts=-1 must be an integer >= 0"),
    ],
)
def test_what_makes_no_sense_is_refused(algorithm: Any, kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        algorithm(POLICIES[algorithm], joint_env(n_envs=2), **kwargs)
