"""
What checkpoints cost: a team that learns with those that a run has by default, against one without, and the time of one.

By default a file is written every ten minutes, and a state is kept in memory so seldom that it takes a hundredth of the time
at most. ``checkpoints_vs_none`` is the ratio of their speeds while the training goes on; the file at its start is not in it.
It is the same team with and without: two equal ones differ by some per cent, by where their matrices lie in memory.
``seconds_of_a_checkpoint`` is the wall-clock time of writing all ten agents with all that decides how they go on.
"""

import tempfile
import time
from pathlib import Path

from benchmarks.measure import ratio, spread
from benchmarks.report import Report
from benchmarks.teams import junction_team
from sb3_belief import Team
from sb3_belief.team import Checkpoints

_KEY, _SECONDS = "checkpoints_vs_none", "seconds_of_a_checkpoint"
# Some twenty seconds in each call
_ROLLOUTS = 20
#: Seconds between files, as ``train.py`` has them if nothing is said
SAVE_EVERY = 600.0


class Learning:
    """
    Loop that lets a team learn with a callback or without.

    :param team: The team
    :param rollouts: Number of rollouts in each call
    :param callback: The callback, if there is one
    """

    def __init__(self, team: Team, rollouts: int, callback: Checkpoints | None = None) -> None:
        self._team, self._callback = team, callback
        env = team.get_env()
        assert env is not None
        (n_steps,) = {model.n_steps for model in team.agents.values()}  # type: ignore[attr-defined]
        self._steps = rollouts * n_steps * env.num_envs

    def __call__(self) -> int:
        """Learn, and return the number of joint steps."""
        before = self._team.num_timesteps
        self._team.learn(self._steps, callback=self._callback, reset_num_timesteps=False)
        return self._team.num_timesteps - before


def run(report: Report) -> None:
    """Measure part ``checkpoints``."""
    report.title("checkpoints", "Traffic Junction as in b, belief_ppo")
    rollouts = 1 if report.quick else _ROLLOUTS
    with tempfile.TemporaryDirectory() as folder:
        team = junction_team("belief_ppo", report.quick)
        callback = Checkpoints(Path(folder, "checkpoints"), save_every=SAVE_EVERY)
        without, with_them = Learning(team, rollouts), Learning(team, rollouts, callback)
        samples = report.measure("checkpoints", {"none": without, "as by default": with_them})
        report.add_ratio(_KEY, ratio(samples["as by default"], samples["none"]), "speed with default checkpoints / without")
        seconds = []
        for _ in range(report.rounds):
            start = time.perf_counter()
            team.save(Path(folder, "team.zip"), exact=True)
            seconds.append(time.perf_counter() - start)
        size = Path(folder, "team.zip").stat().st_size / 2**20
        report.add_ratio(_SECONDS, spread(seconds), f"seconds of a checkpoint of {len(team.agents)} agents, {size:.1f} MiB")
