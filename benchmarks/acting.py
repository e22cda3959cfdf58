"""
Do policies of equal shape act faster together than each by itself?

One team does both in turn, from one joint step to the next, which it can since it learns the same either way: so nothing else
differs, as it would between two teams. Timed is all that lies between two steps of the environment.
"""

import itertools
import statistics
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any
from unittest import mock

from benchmarks.measure import Sample, Spread, spread
from benchmarks.report import Report
from benchmarks.teams import ALGOS, TeamLoop, junction_team, spread_team
from sb3_belief import Team
from sb3_belief.team.lockstep.joint_loop import JointLoop

TOGETHER, APART = "together", "each by itself"


class TurnsLoop(TeamLoop):
    """
    Rollouts whose joint steps are acted in together and apart by turns.

    :param team: what learns
    """

    def __init__(self, team: Team) -> None:
        super().__init__(team)
        self._ways = itertools.cycle((TOGETHER, APART))
        self._way = next(self._ways)
        #: Of each rollout: {way: what lay between one step of the environment and the next}
        self.rollouts: list[dict[str, list[Sample]]] = []

    def __call__(self) -> int:
        step, end_rollouts, chooses_actions = JointLoop._step, JointLoop._end_rollouts, JointLoop.chooses_actions
        samples: dict[str, list[Sample]] = defaultdict(list)
        # When the last step of the environment was done; None after an update, whose time is not to be counted
        since: tuple[float, float] | None = None

        def now() -> tuple[float, float]:
            return time.process_time(), time.perf_counter()

        def timed_step(scheduler: JointLoop, actions: Any) -> Any:
            nonlocal since
            if since is not None:
                cpu, wall = now()
                samples[self._way].append(Sample(scheduler.num_envs, cpu - since[0], wall - since[1]))
            result = step(scheduler, actions)
            self._way = next(self._ways)
            since = now()
            return result

        def untimed_end(scheduler: JointLoop, *args: Any) -> None:
            nonlocal since
            end_rollouts(scheduler, *args)
            since = None

        # A policy that cannot wait for others acts by itself
        def can_wait(scheduler: JointLoop, agent: str) -> bool:
            return self._way == TOGETHER and chooses_actions(scheduler, agent)

        with (
            mock.patch.object(JointLoop, "_step", timed_step),
            mock.patch.object(JointLoop, "_end_rollouts", untimed_end),
            mock.patch.object(JointLoop, "chooses_actions", can_wait),
        ):
            steps = super().__call__()
        self.rollouts.append(dict(samples))
        # So that each way comes first as often as the other
        self._way = next(self._ways)
        return steps

    def gain(self, n_rollouts: int) -> Spread:
        """
        :param n_rollouts: the last ones, which count
        :return: time of a step apart over that of one together, in the medians of each rollout
        """
        medians = [
            [statistics.median(sample.cpu for sample in rollout[way]) for way in (APART, TOGETHER)]
            for rollout in self.rollouts[-n_rollouts:]
        ]
        return spread([apart / together for apart, together in medians])


def run(report: Report) -> None:
    """
    :param report: what is found goes there
    """
    report.title("together", "policies that act together against each by itself, without environment and updates")
    teams: dict[str, Callable[[str, bool], Team]] = {"spread": spread_team, "junction": junction_team}
    for name, make in teams.items():
        for algo in ALGOS:
            loop = TurnsLoop(make(algo, report.quick))
            for _ in range(report.rounds if report.quick else 2 + report.rounds):
                loop()
            samples = {
                f"{name}, {algo}, {way}": [sample for rollout in loop.rollouts[-report.rounds :] for sample in rollout[way]]
                for way in (TOGETHER, APART)
            }
            report.add_samples("together", samples, "joint steps")
            what = f"{name}, team of {algo}: time of acting each by itself / together"
            report.add_ratio(f"together_vs_apart_{name}_{algo}", loop.gain(report.rounds), what)
