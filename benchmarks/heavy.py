"""
Do workers pay for an environment whose step is heavy? Eight copies in workers, each step of which takes 10 ms.

With ``burns`` a step is 10 ms of CPU time (a simulator). Ideally as many copies run at once as there are cores, which is
cores / 10 ms steps per second of wall-clock time. With ``sleeps`` a step is 10 ms of waiting (a server). Ideally all copies
wait at once, which is 8 / 10 ms. ``workers_vs_ideal`` is the share of this ideal that stepping with random actions reaches,
the lower of the two. Shown beside it are a team that learns in these environments (``learning``), which also acts and trains
between the steps, and a control (``bare``): processes that only burn or sleep on request, which is the most that is possible.
"""

import time
from functools import partial
from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv
from stable_baselines3 import PPO

from benchmarks.loop_process import LoopProcess
from benchmarks.measure import Loop, Spread, cores, speeds, spread
from benchmarks.report import Report
from benchmarks.teams import TeamLoop
from sb3_belief import Team, TeamVecEnv, make_team_env

SECONDS, COPIES, EPISODE = 0.01, 8, 25


def pass_time(kind: str) -> None:
    """Let the time of one step pass, which ``"burns"`` CPU time or ``"sleeps"``."""
    if kind == "sleeps":
        time.sleep(SECONDS)
        return
    # The thread's own CPU time: by the wall clock, workers that share a core would all be done at once
    end = time.thread_time() + SECONDS
    while time.thread_time() < end:
        pass


class HeavyEnv(ParallelEnv):
    """
    Environment of two agents whose steps take time and have no content.

    :param kind: ``"burns"`` or ``"sleeps"``
    """

    metadata: dict[str, Any] = {"name": "heavy_v0"}  # noqa: RUF012 (PettingZoo declares it so)

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.possible_agents = ["agent_0", "agent_1"]
        self.agents: list[str] = []
        self.observation_spaces = {agent: spaces.Box(-1.0, 1.0, (8,), np.float32) for agent in self.possible_agents}
        self.action_spaces = {agent: spaces.Discrete(3) for agent in self.possible_agents}
        self._time = 0

    def observation_space(self, agent: str) -> spaces.Space:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space:
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        self.agents, self._time = self.possible_agents[:], 0
        return self._observe(), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        pass_time(self.kind)
        self._time += 1
        acted, over = self.agents, self._time == EPISODE
        if over:
            self.agents = []
        flags = dict.fromkeys(acted, False), dict.fromkeys(acted, over)
        return self._observe(), dict.fromkeys(acted, 0.0), *flags, {agent: {} for agent in acted}

    def _observe(self) -> dict[str, np.ndarray]:
        return {agent: np.zeros(8, dtype=np.float32) for agent in self.possible_agents}


def _stepper(env: TeamVecEnv, n_steps: int) -> Loop:
    draws = np.random.default_rng(0).integers(0, 3, size=(n_steps, len(env.possible_agents), env.num_envs))
    actions = [dict(zip(env.possible_agents, draw, strict=True)) for draw in draws]
    env.reset()

    def loop() -> int:
        for joint in actions:
            env.step(joint)
        return n_steps * env.num_envs

    return loop


def _learner(env: TeamVecEnv, n_steps: int) -> Loop:
    settings: dict[str, Any] = dict(n_steps=n_steps, batch_size=n_steps * env.num_envs // 2, n_epochs=4, device="cpu")
    return TeamLoop(Team(PPO, "MlpPolicy", env, seed=0, **settings))


def _make_bare(kind: str) -> Loop:
    def step() -> int:
        pass_time(kind)
        return 1

    return step


def _bare(processes: list[LoopProcess], n_steps: int) -> Loop:
    def loop() -> int:
        steps = 0
        for _ in range(n_steps):
            for process in processes:
                process.start()
            steps += sum(process.steps() for process in processes)
        return steps

    return loop


def run(report: Report) -> None:
    """Measure part ``workers``."""
    copies, n_steps = (2, 4) if report.quick else (COPIES, 32)
    report.title("workers", f"{copies} copies in workers, each step of a copy takes {1000 * SECONDS:g} ms, {cores()} cores")
    shares: dict[str, Spread] = {}
    for kind, ideal in {"burns": min(cores(), copies) / SECONDS, "sleeps": copies / SECONDS}.items():
        envs = [make_team_env(partial(HeavyEnv, kind), n_envs=copies, vec_env="subproc") for _ in range(2)]
        processes = [LoopProcess(_make_bare, kind) for _ in range(copies)]
        loops = {
            "stepped": _stepper(envs[0], n_steps),
            "learning": _learner(envs[1], n_steps),
            "bare": _bare(processes, n_steps),
        }
        samples = report.measure("workers", {f"{kind}, {name}": loop for name, loop in loops.items()})
        for env in envs:
            env.close()
        for process in processes:
            process.close()
        for name in loops:
            share = shares[f"{kind}_{name}"] = spread([v / ideal for v in speeds(samples[f"{kind}, {name}"], "wall")])
            report.add_ratio(
                f"workers_{kind}_{name}", share, f"steps per wall second / {ideal:,.0f}, the ideal ({kind}, {name})"
            )
    worst = min(shares["burns_stepped"], shares["sleeps_stepped"], key=lambda share: share.median)
    report.add_ratio("workers_vs_ideal", worst, "the lower of those stepped with random actions")
