"""
Where a team's CPU time goes.

The methods that do the work are wrapped with clocks while a team learns, each of which leaves out what those within it take.
That slows the run, so it is apart from those that are compared. Only methods that return before another agent's turn can be
timed so; the rest (SB3's loop over steps, the coroutines, the callbacks, the logs) is what is left.
"""

import functools
import time
from collections import defaultdict
from contextlib import ExitStack
from typing import Any
from unittest import mock

import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv

from benchmarks.measure import cpu_seconds
from benchmarks.report import Report
from benchmarks.teams import TeamLoop
from sb3_belief import Team
from sb3_belief.belief_ppo import algorithm
from sb3_belief.team.batched_forward import networks, passes
from sb3_belief.vec_env.agent_step import AgentTransition
from sb3_belief.vec_env.joint_env import JointEnv
from sb3_belief.vec_env.parallel_team_vec_env import ParallelTeamVecEnv

UPDATE = "update"


class Clocks(ExitStack):
    """Adds up the time of wrapped methods, until it is left."""

    def __init__(self) -> None:
        super().__init__()
        self.seconds: dict[str, float] = defaultdict(float)
        # Of each wrapped call under way: the time of those within it
        self._within: list[float] = []
        self._updating = False

    def wrap(self, owner: Any, method: str, part: str) -> None:
        """
        :param owner: object, class or module
        :param method: name of what to time; without it nothing happens
        :param part: what its time is added to; within the update with that word before it
        """
        timed = getattr(owner, method, None)
        if timed is None:
            return

        @functools.wraps(timed)
        def call(*args: Any, **kwargs: Any) -> Any:
            outer = self._updating
            self._updating = outer or part == UPDATE
            name = f"{UPDATE}: {part}" if outer else part
            self._within.append(0.0)
            start = time.process_time()
            try:
                return timed(*args, **kwargs)
            finally:
                elapsed = time.process_time() - start
                self.seconds[name] += elapsed - self._within.pop()
                if self._within:
                    self._within[-1] += elapsed
                self._updating = outer

        self.enter_context(mock.patch.object(owner, method, call))

    def wrap_team(self, team: Team) -> None:
        """
        :param team: whose work to time
        """
        assert team._scheduler is not None
        env = team._scheduler.env.unwrapped
        if isinstance(env, ParallelTeamVecEnv):
            assert isinstance(env.venv, DummyVecEnv)
            for joint in env.venv.envs:
                assert isinstance(joint, JointEnv)
                for method in ("reset", "step"):
                    self.wrap(joint.env, method, "environment")
        else:
            self.wrap(env, "_step_joint", "environment")
        self.wrap(env, "step", "transfer")
        self.wrap(team._scheduler._views, "parts", "transfer")
        self.wrap(AgentTransition, "as_step", "transfer")
        for model in team.agents.values():
            self._wrap_model(model)
        # Policies with equal networks act together
        for owner, method in ((passes.ForwardRequest, "prepare"), (passes, "make"), (passes.ForwardRequest, "finish")):
            self.wrap(owner, method, "policy")
        self.wrap(networks.StackedNetworks, "believe", "belief")
        self.wrap(th.Tensor, "backward", "backward")
        self.wrap(algorithm, "measure_belief", "belief diagnostics")

    def _wrap_model(self, model: Any) -> None:
        policy = model.policy
        self.wrap(model, "train", UPDATE)
        self.wrap(model, "_update_info_buffer", "buffer")
        for method in ("add", "reset", "compute_returns_and_advantage", "_get_samples", "recent"):
            self.wrap(model.rollout_buffer, method, "buffer")
        self.wrap(policy, "predict_values", "policy")
        self.wrap(policy.optimizer, "step", "optimiser")
        if getattr(policy, "has_belief", False):
            self.wrap(policy, "remember", "belief")
            self.wrap(policy, "belief_loss", "belief")
            self.wrap(policy.belief, "forward", "belief")
            self.wrap(policy.belief, "encode_history", "belief")


def shares(team: Team, iterations: int, warm: bool = True) -> dict[str, float]:
    """
    :param team: to be timed
    :param iterations: rollouts and updates
    :param warm: whether another comes before them, which fills the history
    :return: CPU milliseconds per joint step of each part, and of all together under ``"total"``
    """
    loop = TeamLoop(team)
    if warm:
        loop()
    with Clocks() as clocks:
        clocks.wrap_team(team)
        start = cpu_seconds()
        steps = sum(loop() for _ in range(iterations))
        total = cpu_seconds() - start
    # What SB3's own train() does itself, and the networks that it asks
    clocks.seconds[f"{UPDATE}: forward and loss"] = clocks.seconds.pop(UPDATE)
    found = {**clocks.seconds, "rest": total - sum(clocks.seconds.values()), "total": total}
    return {part: 1000 * seconds / steps for part, seconds in found.items()}


def compare(report: Report, part: str, teams: dict[str, Team]) -> None:
    """
    :param report: what is found goes there, as ``time[part]``
    :param part: of the benchmark
    :param teams: to be timed, among them ``"ippo"`` and ``"belief_ppo"``
    """
    found = {name: shares(team, 1 if report.quick else 2, not report.quick) for name, team in teams.items()}
    report.time[part] = {"ms_per_joint_step": found}
    names = [name for name in dict.fromkeys(name for each in found.values() for name in each) if name != "total"]
    order = [*sorted(names, key=lambda name: (name.startswith(UPDATE), name == "rest")), "total"]
    print("  where the time goes, CPU ms per joint step (share), timed apart with clocks in it:")
    print("  " + " " * 28 + "".join(f"{name:>18s}" for name in found))
    for name in order:
        cells = [f"{each.get(name, 0.0):.3f} ({each.get(name, 0.0) / each['total']:4.0%})" for each in found.values()]
        print(f"  {name:28s}" + "".join(f"{cell:>18s}" for cell in cells))
    updates = {name: sum(ms for each, ms in parts.items() if each.startswith(UPDATE)) for name, parts in found.items()}
    # Its part of the backward pass cannot be timed apart: what an update takes longer than one without is the belief's
    share = 1 - updates["ippo"] / updates["belief_ppo"]
    report.time[part]["belief_share_of_update"] = share
    print(f"  the belief's share of the update: {share:.0%} (all that it takes longer than that of ippo)", flush=True)
