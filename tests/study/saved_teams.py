"""Teams that have learned nothing worth mentioning, as zips and in folders of runs."""

from typing import Any

import yaml

from sb3_belief import BeliefPPO
from sb3_belief.team import Team, make_team_env

EASY = "traffic-junction-easy"
TINY: dict[str, Any] = dict(
    n_steps=8, batch_size=16, n_epochs=1, history_length=12, policy_kwargs=dict(net_arch=[8], embedding_dim=8, latent_dim=4)
)


def save_team(folder, name, seed, belief="dynamic"):
    env = make_team_env(EASY, n_envs=2, seed=seed)
    path = folder / f"{name}.zip"
    Team(BeliefPPO, "BeliefPolicy", env, seed=seed, device="cpu", belief=belief, **TINY).learn(32).save(path)
    return path


def run_folder(team, folder, env=EASY, settings=None, **kwargs):
    """Make the folder of a run that saved a team."""
    folder.mkdir()
    (folder / "team.zip").write_bytes(open(team, "rb").read())
    (folder / "run.json").write_text(
        f'{{"status": "finished", "algo": "belief_ppo", "env": "{env}", "seed": 0, "timesteps": 1}}'
    )
    own = {"policy": "BeliefPolicy", "n_timesteps": 100, "n_envs": 2, "env_kwargs": kwargs, **(settings or {})}
    (folder / "config.yml").write_text(yaml.safe_dump({env: own}))
    return str(folder)
