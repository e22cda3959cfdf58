"""What the loop asks of agents whose models learn in another process."""

from collections.abc import Sequence
from typing import Protocol

from sb3_belief.common.plain_data import PlainData
from sb3_belief.vec_env.agent_vec_env import AgentTransition
from sb3_belief.vec_env.team_vec_env import TeamObs


class AgentGroup(Protocol):
    """
    Agents of the team whose models learn in another process, in lockstep with those in this one.

    :param agents: Their names
    """

    agents: list[str]

    def start(self, first: TeamObs, masks: TeamObs | None, vote: bool) -> None:
        """
        Run the agents up to where they begin their first rollouts.

        :param first: Their observations, if the environment has been reset
        :param masks: The masks of all agents, if there are any
        :param vote: Whether a callback may run between counting a step and what follows
        """

    def step(self, transitions: dict[str, AgentTransition], masks: TeamObs | None) -> None:
        """
        Let the agents count the step and, where there is no vote, finish it.

        :param transitions: The parts of all agents
        :param masks: The masks of all agents, if there are any
        """

    def finish_step(self, continues: bool) -> None:
        """
        Let the agents do what follows after counting the step.

        :param continues: Whether training continues
        """

    def end_rollouts(self) -> None:
        """Let the agents that have ended a rollout train on it."""

    def start_rollouts(self) -> None:
        """Let the agents that are to begin a rollout choose their first actions."""

    def restore(self, states: dict[str, PlainData]) -> None:
        """
        Put the agents' exact states back.

        :param states: By agent
        """

    def act(self, agents: Sequence[str]) -> None:
        """
        Let agents act that have finished learning.

        :param agents: Their names
        """

    def result(self) -> tuple[dict[str, str], TeamObs]:
        """
        Wait for what was asked of the group last.

        :return: The state and the actions of each agent that has been resumed since the last result
        :raises BaseException: Whatever one of the agents raised
        """
