"""The scheduler of the agents in a worker process."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from sb3_belief.common.rng import RngState, RngSwitch
from sb3_belief.team.lockstep.scheduler import ROLLOUT_ENDED, AgentTask, Scheduler
from sb3_belief.vec_env.agent_vec_env import AgentTransition
from sb3_belief.vec_env.team_vec_env import TeamObs


class GroupScheduler(Scheduler):
    """
    A scheduler that the loop in the main process tells when to resume its agents.

    Between its methods no agent's random number generators are the current ones.

    :param first: Observations of the reset by agent, if there was one
    :param masks: Action masks by agent, if there are any
    :param vote: Whether agents that have counted a step wait to learn whether training continues
    :param rngs: Lends the global random number generators
    :param idle: Has them in between
    :param kwargs: Arguments of ``Scheduler``
    """

    def __init__(
        self, first: TeamObs, masks: TeamObs | None, vote: bool, rngs: RngSwitch, idle: RngState, **kwargs: Any
    ) -> None:
        self._masks = masks
        super().__init__(**kwargs)
        self._first, self._vote = first, vote
        self._rngs, self._idle = rngs, idle
        self._resumed: set[str] = set()

    @property
    def masks(self) -> dict[str, np.ndarray] | None:
        return self._masks

    def start(self, tasks: dict[str, AgentTask]) -> None:
        """
        Run the agents up to where they begin their first rollouts.

        :param tasks: The agents' tasks
        """
        self._tasks = tasks
        self._start(tasks, self._rngs)
        self._end_turns(tasks)

    def step(self, transitions: dict[str, AgentTransition], masks: TeamObs | None) -> None:
        """
        Let the agents count a step and, where there is no vote, finish it.

        :param transitions: The agents' parts of the step
        :param masks: Their action masks, if there are any
        """
        self._hand_out(transitions)
        self._masks, self._continues = masks, True
        if self._vote:
            for agent in self._learning():
                self._resume(agent)
        else:
            self.finish_step(True)

    def finish_step(self, continues: bool) -> None:
        """
        Let the agents do what follows after counting the step.

        :param continues: Whether training continues
        """
        self._continues = continues
        learning = self._learning()
        self._take_turns(learning, self._rngs)
        self._end_turns(learning)

    def end_rollouts(self) -> list[str]:
        """
        Let the agents that have ended a rollout train on it.

        :return: Their names
        """
        self.n_rounds += 1
        ended = [agent for agent in self._learning() if self._tasks[agent].state == ROLLOUT_ENDED]
        self._take_turns(ended, self._rngs)
        self._end_turns(ended)
        return ended

    def start_rollouts(self) -> None:
        """Let the agents that are to begin a rollout choose their first actions."""
        learning = self._learning()
        self._start_rollouts(learning, self._rngs)
        self._end_turns(learning)

    def act(self, agents: Sequence[str]) -> None:
        """
        Let agents act that have finished learning.

        :param agents: Their names
        """
        for agent in agents:
            self._act(agent, self._rngs)
        self._end_turns(agents)

    def stop(self) -> None:
        """End the coroutines."""
        self._stop_all(None)
        self._rngs.to(self._idle)

    def take_result(self) -> tuple[dict[str, str], TeamObs]:
        """
        Return what the loop needs to know.

        :return: The state and the actions of each agent that was resumed since the last call
        """
        resumed, self._resumed = self._resumed, set()
        states = {agent: self._tasks[agent].state for agent in resumed}
        return states, {agent: self._actions[agent] for agent in resumed if agent in self._actions}

    def _end_turns(self, resumed: Iterable[str]) -> None:
        self._batch_forwards(self._rngs)
        self._rngs.to(self._idle)
        self._resumed.update(resumed)
