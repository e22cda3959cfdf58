"""
Updates on a GPU against the same on the CPU: eight agents with a belief, one after the other, minibatches of 3,200 rows; and
gradient steps on the GPU one after the other against stacked ones (benchmarks/stacked.py).
"""

import statistics
import time
from collections.abc import Callable
from typing import Any

import torch as th

from benchmarks import stacked
from benchmarks.growth import fill_history
from benchmarks.measure import spread
from benchmarks.report import Report
from benchmarks.toys import ToyTeamEnv
from sb3_belief import BeliefPPO, Team

N_AGENTS, BATCH_SIZE, N_ENVS = 8, 3200, 64


class Updates:
    """
    A team whose updates are timed, and nothing else.

    :param device: of its models
    :param quick: small minibatches
    """

    def __init__(self, device: str, quick: bool) -> None:
        rows = N_ENVS if quick else BATCH_SIZE
        env = ToyTeamEnv(N_ENVS, N_AGENTS)
        settings: dict[str, Any] = dict(n_steps=2 * rows // N_ENVS, batch_size=rows, n_epochs=1, seed=0, device=device)
        self._team = Team(BeliefPPO, "BeliefPolicy", env, **settings)
        self._rows, self._seconds, self._cuda = 2 * rows, 0.0, device == "cuda"
        for model in self._team.agents.values():
            assert isinstance(model, BeliefPPO)
            fill_history(model)
            model.train = self._timed(model.train)  # type: ignore[method-assign]

    def _timed(self, train: Callable[[], None]) -> Callable[[], None]:
        def timed() -> None:
            self._wait()
            start = time.perf_counter()
            train()
            self._wait()
            self._seconds += time.perf_counter() - start

        return timed

    def _wait(self) -> None:
        if self._cuda:
            th.cuda.synchronize()

    def seconds(self) -> float:
        """
        :return: that the updates of all agents take after one rollout, two minibatches each
        """
        self._seconds = 0.0
        self._team.learn(self._rows, reset_num_timesteps=False)
        return self._seconds


def run(report: Report, devices: tuple[str, str] = ("cpu", "cuda")) -> None:
    """
    :param report: what is found goes there
    :param devices: the one that is compared with, and the other
    """
    report.title("gpu", f"updates of {N_AGENTS} agents with a belief, {BATCH_SIZE:,} rows a minibatch")
    if "cuda" in devices and not th.cuda.is_available():
        report.skip("gpu", "torch finds no GPU")
        return
    teams = [Updates(device, report.quick) for device in devices]
    for team in teams:
        team.seconds()
    taken = [[team.seconds() for team in teams] for _ in range(report.rounds)]
    for device, seconds in zip(devices, zip(*taken, strict=True), strict=True):
        milliseconds = 1000 * statistics.median(seconds) / 2
        report.time[f"update on {device}"] = {"ms_per_minibatch_of_all_agents": milliseconds}
        print(f"  {device}: {milliseconds:,.1f} ms for one minibatch of each agent")
    report.add_ratio("gpu_vs_cpu_update", spread([cpu / gpu for cpu, gpu in taken]), f"time on {devices[0]} / on {devices[1]}")
    rows = N_ENVS if report.quick else BATCH_SIZE
    gains = stacked.compare(N_AGENTS, rows, report.rounds, devices[1]).gains
    for way in ("lockstep", "stacked"):
        report.add_ratio(
            f"gpu_one_by_one_vs_{way}", gains[way], f"a gradient step of all agents on the GPU, one by one / {way}"
        )
