"""
Do workers pay for an environment whose step is heavy? Eight copies in workers, each step of which takes 10 ms.

``burns``: 10 ms of CPU time (a simulator); ideal are as many copies at once as there are cores, so cores / 10 ms steps per
wall second. ``sleeps``: 10 ms of waiting (a server); ideal are all copies at once, so 8 / 10 ms. ``workers_vs_ideal`` is what
stepping with random actions reaches of that, the lower of the two. A team that learns in them acts and trains between the
steps, which the ideal does not count; it is shown beside. So is the control: processes that do nothing but burn or sleep when
told, which is the most that could be reached.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv
from stable_baselines3 import PPO

from benchmarks.measure import Loop, Spread, cores, speeds, spread
from benchmarks.report import Report
from benchmarks.teams import TeamLoop
from benchmarks.told import Told
from sb3_belief import Team, make_team_env
from sb3_belief.team import TeamVecEnv

SECONDS, COPIES, EPISODE = 0.01, 8, 25


def pass_time(kind: str) -> None:
    """
    :param kind: ``"burns"`` CPU time or ``"sleeps"``
    """
    if kind == "sleeps":
        time.sleep(SECONDS)
        return
    # Its own CPU time: by the clock on the wall, workers that share a core would all be done at once
    end = time.thread_time() + SECONDS
    while time.thread_time() < end:
        pass


class HeavyEnv(ParallelEnv):
    """
    Two agents, whose every step takes its time.

    :param kind: ``"burns"`` CPU time or ``"sleeps"``
    """

    metadata: dict[str, Any] = {"name": "heavy_v0"}  # noqa: RUF012 (PettingZoo's own kind of attribute)

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
        over = self._time == EPISODE
        acted = self.agents
        if over:
            self.agents = []
        flags = dict.fromkeys(acted, False), dict.fromkeys(acted, over)
        return self._observe(), dict.fromkeys(acted, 0.0), *flags, {agent: {} for agent in acted}

    def _observe(self) -> dict[str, np.ndarray]:
        return {agent: np.zeros(8, dtype=np.float32) for agent in self.possible_agents}


class _Steps:
    """Random actions, drawn beforehand."""

    def __init__(self, env: TeamVecEnv, n_steps: int) -> None:
        draws = np.random.default_rng(0).integers(0, 3, size=(n_steps, len(env.possible_agents), env.num_envs))
        self.env, self.actions = env, [dict(zip(env.possible_agents, draw, strict=True)) for draw in draws]
        env.reset()

    def __call__(self) -> int:
        for actions in self.actions:
            self.env.step(actions)
        return len(self.actions) * self.env.num_envs


class _Bare:
    """Processes that only let the time pass: the control."""

    def __init__(self, kind: str, copies: int, n_steps: int) -> None:
        self._copies, self._n_steps = [Told(_step_bare, kind) for _ in range(copies)], n_steps

    def __call__(self) -> int:
        steps = 0
        for _ in range(self._n_steps):
            for copy in self._copies:
                copy.tell()
            steps += sum(copy.steps() for copy in self._copies)
        return steps

    def close(self) -> None:
        """End the processes."""
        for copy in self._copies:
            copy.end()


def _step_bare(kind: str) -> Loop:
    def step() -> int:
        pass_time(kind)
        return 1

    return step


def _learner(env: TeamVecEnv, n_steps: int) -> TeamLoop:
    settings: dict[str, Any] = dict(n_steps=n_steps, batch_size=n_steps * env.num_envs // 2, n_epochs=4, device="cpu")
    return TeamLoop(Team(PPO, "MlpPolicy", env, seed=0, **settings))


def run(report: Report) -> None:
    """
    :param report: what is found goes there
    """
    copies, n_steps = (2, 4) if report.quick else (COPIES, 32)
    report.title("workers", f"{copies} copies in workers, each step of a copy takes {1000 * SECONDS:g} ms, {cores()} cores")
    ideal = {"burns": min(cores(), copies) / SECONDS, "sleeps": copies / SECONDS}
    makers: dict[str, Callable[[TeamVecEnv, int], _Steps | TeamLoop]] = {"stepped": _Steps, "learning": _learner}
    shares: dict[str, Spread] = {}
    for kind, best in ideal.items():
        envs = [make_team_env(partial(HeavyEnv, kind), n_envs=copies, vec_env="subproc") for _ in makers]
        bare = _Bare(kind, copies, n_steps)
        loops: dict[str, Loop] = {
            f"{kind}, {name}": make(env, n_steps) for (name, make), env in zip(makers.items(), envs, strict=True)
        }
        samples = report.measure("workers", {**loops, f"{kind}, bare": bare})
        bare.close()
        for env in envs:
            env.close()
        shares.update({name: spread([v / best for v in speeds(samples[name], "wall")]) for name in samples})
    for name, share in shares.items():
        key = "workers_" + name.replace(", ", "_")
        report.add_ratio(key, share, f"steps per wall second / {ideal[name.split(',')[0]]:,.0f}, the ideal ({name})")
    worst = min((share for name, share in shares.items() if name.endswith("stepped")), key=lambda share: share.median)
    report.add_ratio("workers_vs_ideal", worst, "the lower of those stepped with random actions")
