"""
What checkpoints cost a team that learns with those that a run has by default, and the time of one.

By default a file is written every ten minutes, and a state is kept in memory so seldom that it takes a hundredth of the time
at most. ``checkpoints_vs_none`` is the ratio of the speeds with and without them, from the share of the CPU time that they
take: what they cost is less than what two equal trainings differ by. The file at the start is not in it.
``seconds_of_a_checkpoint`` is the wall-clock time of writing all ten agents with all that decides how they go on.
"""

import tempfile
import time
from pathlib import Path
from unittest.mock import patch

from benchmarks.measure import spread
from benchmarks.report import Report
from benchmarks.teams import junction_team
from sb3_belief.team import Checkpoints

_KEY, _SECONDS = "checkpoints_vs_none", "seconds_of_a_checkpoint"
# Some twenty seconds, so that a state is kept in about every call
_ROLLOUTS = 26
#: Seconds between files, as ``train.py`` has them if nothing is said
SAVE_EVERY = 600.0


def run(report: Report) -> None:
    """Measure part ``checkpoints``."""
    report.title("checkpoints", "Traffic Junction as in b, belief_ppo")
    team = junction_team("belief_ppo", report.quick)
    env = team.get_env()
    assert env is not None
    (n_steps,) = {model.n_steps for model in team.agents.values()}  # type: ignore[attr-defined]
    steps = (1 if report.quick else _ROLLOUTS) * n_steps * env.num_envs
    spent, begin_rollout = 0.0, Checkpoints._on_rollout_start

    def timed(self: Checkpoints) -> None:
        nonlocal spent
        start = time.process_time()
        begin_rollout(self)
        spent += time.process_time() - start

    with tempfile.TemporaryDirectory() as folder:
        callback = Checkpoints(Path(folder, "checkpoints"), save_every=SAVE_EVERY)
        # With the file at its start
        team.learn(1, callback=callback)
        ratios = []
        with patch.object(Checkpoints, "_on_rollout_start", timed):
            for _ in range(report.rounds):
                spent, start = 0.0, time.process_time()
                team.learn(steps, callback=callback, reset_num_timesteps=False)
                ratios.append(1 - spent / (time.process_time() - start))
        report.add_ratio(_KEY, spread(ratios), "speed with default checkpoints / without")
        seconds = []
        for _ in range(report.rounds):
            start = time.perf_counter()
            team.save(Path(folder, "team.zip"), exact=True)
            seconds.append(time.perf_counter() - start)
        size = Path(folder, "team.zip").stat().st_size / 2**20
        report.add_ratio(_SECONDS, spread(seconds), f"seconds of a checkpoint of {len(team.agents)} agents, {size:.1f} MiB")
