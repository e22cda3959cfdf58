"""The hub of agents that learn in a worker process, in lockstep with the rest of their team."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from sb3_belief.common.rng import RngState, RngSwitch
from sb3_belief.team.lockstep.scheduler import ROLLOUT_ENDED, AgentTask, Scheduler
from sb3_belief.vec_env.agent_vec_env import AgentTransition
from sb3_belief.vec_env.team_vec_env import TeamObs


class GroupScheduler(Scheduler):
    """
    A hub that is told by the one in the main process when it is whose turn. Between its methods no agent's random stream is
    the current one.

    :param first: {agent: observations of the reset, if there was one}
    :param masks: {agent: its action masks}, if there are any
    :param vote: whether agents that have counted a step wait to be told whether to go on
    :param streams: lends the global generators
    :param idle: the stream that has them meanwhile
    :param kwargs: of ``Scheduler``
    """

    def __init__(self, first: TeamObs, masks: TeamObs | None, vote: bool, streams: RngSwitch, idle: RngState, **kwargs: Any):
        self._given_masks = masks
        super().__init__(**kwargs)
        self._first, self._vote = first, vote
        self._streams, self._idle = streams, idle
        self._moved: set[str] = set()

    @property
    def masks(self) -> dict[str, np.ndarray] | None:
        return self._given_masks

    def start(self, tasks: dict[str, AgentTask]) -> None:
        """
        :param members: who learns here
        """
        self._tasks = tasks
        self._start(tasks, self._streams)
        self._end_turns(tasks)

    def step(self, parts: dict[str, AgentTransition], masks: TeamObs | None) -> None:
        """
        :param parts: of the agents
        :param masks: of the agents, if there are any
        """
        self._hand_out(parts)
        self._given_masks, self._continues = masks, True
        if self._vote:
            for agent in self._learning():
                self._resume(agent)
        else:
            self.finish_step(True)

    def finish_step(self, continues: bool) -> None:
        """
        :param continues: whether training continues
        """
        self._continues = continues
        learning = self._learning()
        self._take_turns(learning, self._streams)
        self._end_turns(learning)

    def end_rollouts(self) -> list[str]:
        """
        Those who have ended a rollout are updated.

        :return: who has been
        """
        self.n_rounds += 1
        ended = [agent for agent in self._learning() if self._tasks[agent].state == ROLLOUT_ENDED]
        self._take_turns(ended, self._streams)
        self._end_turns(ended)
        return ended

    def act(self, agents: Sequence[str]) -> None:
        """
        :param agents: who have finished learning, and act once more
        """
        for agent in agents:
            self._act(agent, self._streams)
        self._end_turns(agents)

    def stop(self) -> None:
        """End the coroutines."""
        self._stop_all(None)
        self._streams.to(self._idle)

    def take_moves(self) -> tuple[dict[str, str], TeamObs]:
        """
        :return: {agent: why it waits} and {agent: what it does} of those who have gone on since the last time
        """
        moved, self._moved = self._moved, set()
        states = {agent: self._tasks[agent].state for agent in moved}
        return states, {agent: self._actions[agent] for agent in moved if agent in self._actions}

    def _end_turns(self, moved: Iterable[str]) -> None:
        self._batch_forwards(self._streams)
        self._streams.to(self._idle)
        self._moved.update(moved)
