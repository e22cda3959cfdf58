"""Who takes part in lockstep: the agents as the hub sees them, and the team that observes."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from greenlet import greenlet
from stable_baselines3.common.callbacks import BaseCallback, CallbackList

from sb3_belief.common.rng import RngState
from sb3_belief.vec_env.team_vec_env import TeamObs, TeamStep

if TYPE_CHECKING:
    from sb3_belief.team.lockstep.scheduler import Scheduler

# Why an agent's coroutine has switched to the hub
ACTS, COUNTED, ROLLOUT_ENDED, FINISHED = "acts", "counted", "rollout ended", "finished"
# With updates in several processes: it is to be updated in this one, or waits for the others to be
UPDATES_HERE, UPDATES = "updates here", "updates"
# It is ready to choose its next action together with others
BATCHES_FORWARD = "acts here"


@dataclass
class AgentTask:
    """
    An agent as the hub sees it.

    :param learn: runs the model's ``learn()`` with the callback it is given
    :param act: chooses actions when the agent has finished learning: (observations, episode starts, masks) -> actions
    :param stream: what the agent draws from
    :param callback: the user's own for this agent, if any
    """

    learn: Callable[[BaseCallback], None]
    act: Callable[[np.ndarray, np.ndarray, np.ndarray | None], np.ndarray]
    stream: RngState
    callback: BaseCallback | None = None
    state: str = FINISHED
    coroutine: greenlet = field(init=False)


class SyncCallback(CallbackList):
    """
    An agent's own callback, and then the wait for the others.

    What runs at every step is written out: where there is no callback, SB3's own bookkeeping for one would be waste.
    """

    def __init__(self, scheduler: "Scheduler", agent: str, callback: BaseCallback | None):
        super().__init__([] if callback is None else [callback])
        self._scheduler, self._agent = scheduler, agent

    def update_locals(self, locals_: dict[str, Any]) -> None:
        for callback in self.callbacks:
            callback.update_locals(locals_)

    def on_step(self) -> bool:
        return self._scheduler.vote(self._agent, super().on_step() if self.callbacks else True)

    def _on_rollout_end(self) -> None:
        super()._on_rollout_end()
        self._scheduler.wait(self._agent, ROLLOUT_ENDED)


class Observer(Protocol):
    """
    What the team does between the agents; all of it draws from the team's own stream.

    :param has_callback: whether ``on_step`` looks at the agents, or can say no
    """

    has_callback: bool

    def on_rollout_start(self) -> None:
        """Called before the first step of a rollout."""

    def on_step(self, actions: TeamObs, step: TeamStep) -> bool:
        """
        :param actions: of this step
        :param step: what the joint environment returned
        :return: whether to go on
        """

    def on_rollout_end(self) -> None:
        """Called when all who still learn have ended a rollout since the last time, before they train on it."""

    def on_round_end(self, learning: list[str]) -> None:
        """
        Called when rollouts have ended and those whose were have trained on them.

        :param learning: who still learns
        """
