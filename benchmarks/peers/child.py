"""
What every compared program shares: the workload, and how it answers. Only the standard library, PyTorch and mpe2 are needed
here, which every peer's environment has.

A program trains iteration after iteration (a rollout and the update after it) and calls ``Turns.end`` after each. It then
waits until it is asked for the next one, so that only one program runs at a time.
"""

import argparse
import json
import os
import sys
from dataclasses import dataclass
from importlib import metadata
from typing import Any


@dataclass(frozen=True)
class Workload:
    """
    Independent PPO on simple_spread, with the defaults of Stable-Baselines3's PPO.

    :param n_steps: of each copy in a rollout
    :param n_epochs: passes over the rollout in an update
    """

    n_steps: int = 128
    n_epochs: int = 10
    n_envs: int = 8
    n_minibatches: int = 4
    hidden: tuple[int, int] = (64, 64)
    lr: float = 3e-4
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip: float = 0.2
    vf_coef: float = 0.5
    max_grad_norm: float = 0.5

    @property
    def rows(self) -> int:
        """Rows of a rollout, of each agent: its joint steps."""
        return self.n_envs * self.n_steps

    @property
    def batch_size(self) -> int:
        """Rows of a minibatch, of each agent."""
        return self.rows // self.n_minibatches


class Count:
    """What was really done in the first iteration: a peer's settings may mean something else than they seem to."""

    def __init__(self) -> None:
        import torch.optim.optimizer as optimizers
        from mpe2._mpe_utils.core import World

        self.work = {"joint_steps": 0, "optimiser_steps": 0, "updated_parameters": 0}
        step = World.step

        def counted(world: Any) -> None:
            self.work["joint_steps"] += 1
            step(world)

        World.step = counted
        self._restore = lambda: setattr(World, "step", step)
        self._hook = optimizers.register_optimizer_step_post_hook(self._stepped)

    def _stepped(self, optimizer: Any, *_: Any) -> None:
        parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
        self.work["optimiser_steps"] += 1
        self.work["updated_parameters"] += sum(each.numel() for each in parameters if each.grad is not None)

    def stop(self) -> dict[str, int]:
        """
        :return: steps of all copies together, steps of all optimisers and the parameters that these changed, each time anew;
            all of this process only
        """
        self._restore()
        self._hook.remove()
        # None were seen where other processes step the environments
        return {name: number for name, number in self.work.items() if number > 0}


class Turns:
    """
    Answers on standard output, one line of JSON for each iteration. The first is the warm-up, whose answer says what was done.

    :param packages: whose versions to tell
    """

    def __init__(self, *packages: str) -> None:
        # What a library prints goes to where the errors go
        self._answers = os.fdopen(os.dup(1), "w")
        os.dup2(2, 1)
        import torch

        torch.set_num_threads(1)
        self._versions = {package: metadata.version(package) for package in (*packages, "torch", "numpy", "mpe2")}
        self._count: Count | None = Count()

    def end(self, steps: int) -> None:
        """
        :param steps: joint steps of the iteration that has ended
        """
        answer: dict[str, Any] = {"steps": steps}
        if self._count is not None:
            answer |= {"versions": self._versions, "work": self._count.stop()}
            self._count = None
        print(json.dumps(answer), file=self._answers, flush=True)
        if not sys.stdin.readline():
            raise SystemExit


def workload(parser: argparse.ArgumentParser | None = None) -> tuple[Workload, argparse.Namespace]:
    """
    :param parser: of a program with arguments of its own
    :return: what to train, and all arguments of the command line
    """
    parser = parser or argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true", help="a tiny rollout and one epoch")
    args = parser.parse_args()
    return Workload(n_steps=8, n_epochs=1) if args.quick else Workload(), args
