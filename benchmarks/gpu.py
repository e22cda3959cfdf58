"""Updates on a GPU against the same on the CPU: eight agents with a belief, one after the other, minibatches of 3,200 rows."""

import statistics
from typing import Any

import torch as th

from benchmarks.growth import toy_team
from benchmarks.measure import ratio
from benchmarks.report import Report
from benchmarks.teams import TeamLoop, time_of

N_AGENTS, BATCH_SIZE, N_ENVS = 8, 3200, 64
# Several epochs, so that what else is counted as update (see TeamLoop) does not matter
N_EPOCHS, MINIBATCHES = 4, 2


def run(report: Report, devices: tuple[str, str] = ("cpu", "cuda")) -> None:
    """
    Measure part ``gpu``.

    :param report: Receives the results
    :param devices: The device to compare with, and the other one
    """
    report.title("gpu", f"updates of {N_AGENTS} agents with a belief, {BATCH_SIZE:,} rows a minibatch")
    if "cuda" in devices and not th.cuda.is_available():
        report.skip("gpu", "torch finds no GPU")
        return
    rows = N_ENVS if report.quick else BATCH_SIZE
    own: dict[str, Any] = dict(n_steps=MINIBATCHES * rows // N_ENVS, batch_size=rows, n_epochs=N_EPOCHS)
    loops = [TeamLoop(toy_team("belief_ppo", N_AGENTS, n_envs=N_ENVS, **own, device=device)) for device in devices]
    for _ in range(1 + report.rounds):
        for loop in loops:
            loop()
    first, second = taken = [time_of(loop.phases[-report.rounds :], "update") for loop in loops]
    for device, samples in zip(devices, taken, strict=True):
        milliseconds = 1000 * statistics.median(sample.wall for sample in samples) / (N_EPOCHS * MINIBATCHES)
        report.time[f"update on {device}"] = {"ms_per_minibatch_of_all_agents": milliseconds}
        print(f"  {device}: {milliseconds:,.1f} ms for one minibatch of each agent")
    report.add_ratio("gpu_vs_cpu_update", ratio(second, first, "wall"), f"time on {devices[0]} / on {devices[1]}")
