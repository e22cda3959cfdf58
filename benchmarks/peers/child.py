"""
What all compared programs share: the workload, and how they answer.

This needs only the standard library, PyTorch and mpe2, which the environment of every peer has. A program trains iteration
after iteration (a rollout and the update after it) and calls ``Turns.end`` after each. That waits for the request for the next
iteration, so that only one program runs at a time.
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

    :param n_steps: Steps of each copy in a rollout
    :param n_epochs: Passes over the rollout in an update
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
        """Rows of each agent in a rollout, which are its joint steps."""
        return self.n_envs * self.n_steps

    @property
    def batch_size(self) -> int:
        """Rows of each agent in a minibatch."""
        return self.rows // self.n_minibatches


class Count:
    """Count of the work that is really done, since a peer's settings may not mean what they seem to mean."""

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
        Stop counting.

        :return: Steps of all copies, steps of all optimisers, and parameters that these changed, summed over their steps. All
            are those of this process only
        """
        self._restore()
        self._hook.remove()
        # Where other processes step the environments, none of their steps were seen here
        return {name: number for name, number in self.work.items() if number > 0}


class Turns:
    """
    Answers on standard output, one line of JSON after each iteration.

    The first iteration is the warm-up. Its answer also has the versions and the work that was done.

    :param packages: Packages whose versions to report
    """

    def __init__(self, *packages: str) -> None:
        # What a library prints is sent to standard error, so that it does not mix with the answers
        self._answers = os.fdopen(os.dup(1), "w")
        os.dup2(2, 1)
        import torch

        torch.set_num_threads(1)
        self._versions = {package: metadata.version(package) for package in (*packages, "torch", "numpy", "mpe2")}
        self._count: Count | None = Count()

    def end(self, steps: int) -> None:
        """Answer that an iteration of so many joint steps has ended, and wait for the next request."""
        answer: dict[str, Any] = {"steps": steps}
        if self._count is not None:
            answer |= {"versions": self._versions, "work": self._count.stop()}
            self._count = None
        print(json.dumps(answer), file=self._answers, flush=True)
        if not sys.stdin.readline():
            raise SystemExit


def workload(parser: argparse.ArgumentParser | None = None) -> tuple[Workload, argparse.Namespace]:
    """Return the workload and all arguments of the command line, given the parser of a program with arguments of its own."""
    parser = parser or argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true", help="a tiny rollout and one epoch")
    args = parser.parse_args()
    return Workload(n_steps=8, n_epochs=1) if args.quick else Workload(), args
