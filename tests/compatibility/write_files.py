"""
Write the files that ``test_saved_files.py`` loads: ``python -m tests.compatibility.write_files FOLDER``.

Those in ``data/`` were written by the version before the package was rearranged. To keep files of a further version, write
them into a folder of their own beside it, with that version installed.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_belief import BeliefPPO, MaskableBeliefPPO, Team, make_team_env
from sb3_belief.cli.main import main as command

ENV_ID, RUN_ENV_ID = "traffic-junction-easy", "convention-redraw"
SMALL: dict[str, Any] = {
    "n_steps": 16,
    "batch_size": 16,
    "n_epochs": 1,
    "history_length": 12,
    "keep_ratio": 0.25,
    "policy_kwargs": {"net_arch": [8], "embedding_dim": 4, "latent_dim": 4},
}


def observations(width: int) -> np.ndarray:
    """
    :param width: Width of an observation
    :return: The observations on which models are compared, float32 ``[4, width]``
    """
    return np.random.default_rng(0).normal(size=(4, width)).astype(np.float32)


def outputs(model: Any) -> dict[str, list]:
    """
    :param model: A model with a belief
    :return: What it does, expects and believes of the observations
    """
    obs = observations(model.observation_space.shape[0])
    tensor = th.as_tensor(obs)
    with th.no_grad():
        values = model.policy.predict_values(tensor).flatten()
        probabilities = model.policy.get_distribution(tensor).distribution.probs
    believed = model.policy.predict_others(obs)
    return {
        "actions": model.predict(obs, deterministic=True)[0].tolist(),
        "values": values.tolist(),
        "probabilities": probabilities.tolist(),
        "belief": believed.mean.tolist(),
        "others": [expected.tolist() for expected in believed.actions.values()],
    }


def main(folder: Path) -> None:
    """
    :param folder: Where the files go
    """
    folder.mkdir(parents=True)
    expected = {}
    for name, algorithm, normalize in (("team", BeliefPPO, True), ("agent", MaskableBeliefPPO, False)):
        env = make_team_env(ENV_ID, n_envs=2, seed=0)
        team = Team(algorithm, "BeliefPolicy", env, seed=0, normalize=normalize, **SMALL)
        team.learn(64)
        if normalize:
            team.save(folder / "team.zip")
        else:
            team.agents["car_1"].save(folder / "agent.zip")
        expected[name] = {agent: outputs(model) for agent, model in team.agents.items()}
    overrides = [f"{key}:{value}" for key, value in SMALL.items() if key != "policy_kwargs"]
    overrides += ["n_envs:2", "policy_kwargs:{net_arch: [8], embedding_dim: 4, latent_dim: 4}"]
    run = ["train", "--env", RUN_ENV_ID, "-n", "64", "-f", str(folder / "results"), "--eval-freq", "32", "-params", *overrides]
    assert command([*run, "--seed", "0"]) == 0
    (folder / "expected.json").write_text(json.dumps(expected))


if __name__ == "__main__":
    th.set_num_threads(1)
    main(Path(sys.argv[1]))
