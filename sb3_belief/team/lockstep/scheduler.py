"""
Where the agents whose models learn in one process meet.

SB3's ``learn()`` owns its environment loop, so each runs in a coroutine (a greenlet) of its own, which switches here wherever
it has to wait for others.
"""

import contextvars
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import torch as th
from greenlet import GreenletExit, getcurrent, greenlet
from gymnasium import spaces

from sb3_belief.common.exceptions import add_note
from sb3_belief.common.rng import RngSwitch
from sb3_belief.team.lockstep.agent_task import ACTS, BATCHES_FORWARD, COUNTED, FINISHED, AgentTask, SyncCallback
from sb3_belief.vec_env.agent_step import AgentStep, AgentTransition
from sb3_belief.vec_env.agent_vec_env import AgentVecEnv
from sb3_belief.vec_env.team_vec_env import TeamObs


class Scheduler(ABC):
    """
    Lets the agents of this process take turns, and hands out their parts of the joint steps.

    :param num_envs: number of copies of the environment
    :param observation_spaces: {agent: its observation space} of the agents that may learn here
    :param action_spaces: {agent: its action space} of all agents, in order
    :param scripted_action_spaces: the same of the scripted others
    :param render_mode: of the environment
    """

    def __init__(
        self,
        num_envs: int,
        observation_spaces: Mapping[str, spaces.Space],
        action_spaces: Mapping[str, spaces.Space],
        scripted_action_spaces: Mapping[str, spaces.Space],
        render_mode: str | None,
    ):
        self.num_envs = num_envs
        self.observation_spaces, self.action_spaces = dict(observation_spaces), dict(action_spaces)
        self.scripted_action_spaces = dict(scripted_action_spaces)
        self.render_mode = render_mode
        #: Who learns here
        self._tasks: dict[str, AgentTask] = {}
        self._main: greenlet | None = None
        self._first: dict[str, np.ndarray] = {}
        self._actions: TeamObs = {}
        self._parts: dict[str, AgentTransition] = {}
        self._obs: TeamObs = {}
        self._starts: dict[str, np.ndarray] = {}
        # Whether to go on after this step, and whether the agents wait to be told
        self._go_on = self._vote = True
        #: How often agents have ended rollouts and been updated in this ``learn()``
        self.n_rounds = 0
        self.agent_envs = {agent: AgentVecEnv(self, agent) for agent in self.observation_spaces}

    # For the agents' environments and callbacks

    @property
    @abstractmethod
    def masks(self) -> dict[str, np.ndarray] | None:
        """
        :return: action masks for the current observations, {agent: bool [num_envs, k]}, or None
        """

    def first_observation(self, agent: str) -> np.ndarray:
        """
        :param agent: who asks
        :return: its observations of the last joint reset, once
        :raises RuntimeError: if there was none since it asked
        """
        if agent not in self._first:
            raise RuntimeError(
                f"The environment of {agent!r} is reset only together with the others', once at the beginning of Team.learn():"
                " an algorithm that resets it by itself cannot learn in a team, and an agent alone can only predict."
            )
        return self._first.pop(agent)

    def exchange(self, agent: str, actions: np.ndarray) -> AgentStep:
        """
        :param agent: who acts
        :param actions: array [num_envs, ...]
        :return: its part of the joint step
        """
        self._actions[agent] = actions
        self.wait(agent, ACTS)
        return self._parts.pop(agent).as_step()

    def vote(self, agent: str, go_on: bool) -> bool:
        """
        :param agent: who has counted a step
        :param go_on: what its own callbacks say
        :return: what all say
        """
        if not self._vote:
            return True
        self._go_on = self._go_on and bool(go_on)
        self.wait(agent, COUNTED)
        return self._go_on

    def wait(self, agent: str, state: str) -> None:
        """
        Switch to the hub until it is this agent's turn again.

        :param agent: who waits
        :param state: for what
        """
        if self._main is None or not self._is_in_turn(agent):
            raise RuntimeError(
                f"The environment of {agent!r} steps only together with the others': call learn() of the Team,"
                " not of the agent's model."
            )
        # Whether gradients are recorded is a state of the thread, which the agents share
        grad_enabled = th.is_grad_enabled()
        self._main.switch(state)
        if th.is_grad_enabled() != grad_enabled:
            th.set_grad_enabled(grad_enabled)

    def chooses_actions(self, agent: str) -> bool:
        """
        :param agent: whose policy is asked
        :return: whether its own ``learn()`` asks, so that it can wait for others; where it has a callback that cannot be told
        """
        task = self._tasks.get(agent)
        return task is not None and task.callback is None and self._is_in_turn(agent)

    def _is_in_turn(self, agent: str) -> bool:
        """Whether this is called in the agent's own ``learn()``."""
        task = self._tasks.get(agent)
        return task is not None and getcurrent() is getattr(task, "coroutine", None)

    def get_images(self) -> Sequence[np.ndarray | None]:
        """
        :return: an image of each copy, where there can be one in this process
        """
        return [None] * self.num_envs

    # Turns

    def _start(self, agents: Iterable[str], streams: RngSwitch) -> None:
        """Let them go up to their first actions."""
        self._main = getcurrent()
        for agent in agents:
            task = self._tasks[agent]
            task.coroutine = greenlet(task.learn)
            # Greenlets start with an empty context; the caller's settings (e.g. np.errstate) hold for the agents too
            task.coroutine.gr_context = contextvars.copy_context()
            streams.to(task.stream)
            self._resume(agent, SyncCallback(self, agent, task.callback))

    def _hand_out(self, parts: dict[str, AgentTransition]) -> None:
        """
        :param parts: of a joint step, which the agents are given when it is their turn
        """
        self._parts = parts
        self._obs = {agent: part.obs for agent, part in parts.items()}
        self._starts = {agent: part.dones for agent, part in parts.items()}

    def _learning(self) -> list[str]:
        return [agent for agent, task in self._tasks.items() if task.state != FINISHED]

    def _take_turns(self, agents: Iterable[str], streams: RngSwitch) -> None:
        """Each in its own random stream."""
        for agent in agents:
            streams.to(self._tasks[agent].stream)
            self._resume(agent)

    def _await_actions(self, streams: RngSwitch) -> None:
        """Those who are ready to act together do so."""
        self._take_turns([agent for agent, task in self._tasks.items() if task.state == BATCHES_FORWARD], streams)

    def _act(self, agent: str, streams: RngSwitch) -> None:
        """What an agent does that has finished learning."""
        task, masks = self._tasks[agent], self.masks
        streams.to(task.stream)
        mask = None if masks is None else masks.get(agent)
        self._actions[agent] = task.act(self._obs[agent], self._starts[agent], mask)

    def _resume(self, agent: str, *args: object) -> None:
        task = self._tasks[agent]
        grad_enabled = th.is_grad_enabled()
        try:
            state = task.coroutine.switch(*args)
        except Exception as error:
            add_note(error, f"Raised by agent {agent!r}.")
            raise
        finally:
            if th.is_grad_enabled() != grad_enabled:
                th.set_grad_enabled(grad_enabled)
        task.state = FINISHED if task.coroutine.dead else state

    def _stop_all(self, error: BaseException | None) -> None:
        """End the coroutines so that their ``finally`` blocks run."""
        running = [(agent, task) for agent, task in self._tasks.items() if getattr(task, "coroutine", None)]
        self._main = None
        for agent, task in running:
            try:
                task.coroutine.throw(GreenletExit)
            except Exception as second:
                if error is not None:
                    add_note(error, f"Agent {agent!r}, stopped because of this, raised {second!r}.")
