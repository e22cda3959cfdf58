"""A crash while a real team is saved, at whatever write, leaves a team that is the old or the new one."""

import pytest
from stable_baselines3 import PPO

from sb3_belief.team import Checkpoints, Team
from sb3_belief.team.checkpoints import checkpoint_files
from tests.common.crashes import check_old_or_new, recorded
from tests.team.helpers import PPO_KWARGS, make_team_env
from tests.team.toy_envs import ToyEnv


def make_team(callback):
    """Let a team learn for three rollouts of eight joint steps."""
    team = Team(PPO, "MlpPolicy", make_team_env(ToyEnv, n_envs=1), seed=0, normalize=True, **{**PPO_KWARGS, "n_steps": 8})
    return team.learn(24, callback=callback)


@pytest.mark.parametrize("exact", [False, True])
def test_a_saved_team_is_the_old_or_the_new_one(tmp_path, monkeypatch, exact):
    """Also one with all that is needed to go on exactly."""
    folder = tmp_path / "teams"
    folder.mkdir()
    path = folder / "team.zip"
    team = make_team([])
    team.save(path)
    old = path.read_bytes()
    team.learn(16, reset_num_timesteps=False)
    with recorded(folder, monkeypatch) as disk:
        team.save(path, exact=exact)
    new = path.read_bytes()
    assert len([step for step in disk.steps if step[0] == "write"]) > 1
    check_old_or_new(disk, path.name, old, new)
    assert Team.load(path).num_timesteps == 40
    path.write_bytes(old)
    assert Team.load(path).num_timesteps == 24


def test_there_are_always_whole_checkpoints(tmp_path, monkeypatch):
    """The oldest one is removed only when the new one is there whatever happens."""
    folder, disks = tmp_path / "checkpoints", []
    folder.mkdir()

    class LastRecorded(Checkpoints):
        def _on_rollout_start(self):
            if self.num_timesteps < 16:
                super()._on_rollout_start()
                return
            with recorded(folder, monkeypatch) as disk:
                super()._on_rollout_start()
            disks.append(disk)

    # Two stay
    make_team(LastRecorded(folder, save_freq=8))
    (disk,) = disks
    assert [steps for steps, _ in checkpoint_files(folder)] == [8, 16]
    oldest, middle, newest = (f"team_{steps}_steps.zip" for steps in (0, 8, 16))
    content = {**disk.first, newest: (folder / newest).read_bytes()}
    assert sorted(disk.first) == [oldest, middle]
    seen = set()
    for n_steps in range(len(disk.steps) + 1):
        for files in disk.after_crashes(n_steps):
            named = {name: found for name, found in files.items() if name.endswith("_steps.zip")}
            assert all(content[name] == found for name, found in named.items()), disk.steps[:n_steps]
            seen.add(tuple(sorted(named)))
    assert seen == {(oldest, middle), tuple(sorted((oldest, middle, newest))), tuple(sorted((middle, newest)))}
