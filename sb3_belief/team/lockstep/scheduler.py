"""
Turns of the agents whose models learn in one process.

SB3's ``learn()`` owns its environment loop, so each agent's runs in a coroutine (a greenlet) of its own, which switches to the
scheduler wherever it has to wait for other agents. There is one thread and one order, that of the team, so runs are
deterministic.
"""

import contextvars
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import torch as th
from greenlet import GreenletExit, getcurrent, greenlet
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback, CallbackList

from sb3_belief.common.exceptions import add_note
from sb3_belief.common.rng import RngState, RngSwitch
from sb3_belief.vec_env.agent_vec_env import AgentStep, AgentTransition, AgentVecEnv
from sb3_belief.vec_env.team_vec_env import TeamObs

# Why an agent's coroutine has switched to the scheduler: it is to begin a rollout, has chosen its actions, counted a step, or
# ended a rollout
ROLLOUT_STARTS, ACTS, COUNTED, ROLLOUT_ENDED, FINISHED = "rollout starts", "acts", "counted", "rollout ended", "finished"
# Its policy waits for those of other agents, to make their forward passes in one batch
BATCHES_FORWARD = "batches forward"


@dataclass
class AgentTask:
    """
    What the scheduler knows of one agent.

    :param learn: Runs the model's ``learn()`` with the callback that it is given
    :param act: Chooses actions once the agent has finished learning: (observations, episode starts, masks) -> actions
    :param rng: The agent's own random number generators
    :param callback: The user's callback for this agent, if there is one
    :param state: Why the coroutine has switched to the scheduler, one of the constants above
    :param coroutine: Runs ``learn``
    """

    learn: Callable[[BaseCallback], None]
    act: Callable[[np.ndarray, np.ndarray, np.ndarray | None], np.ndarray]
    rng: RngState
    callback: BaseCallback | None = None
    state: str = FINISHED
    coroutine: greenlet = field(init=False)


class UpdateCheck(Protocol):
    """What looks at an agent's updates."""

    def arm(self) -> None:
        """Look at the next update."""

    def disarm(self) -> None:
        """Look at none."""


class SyncCallback(CallbackList):
    """
    Runs an agent's own callback, then waits for the other agents: at each step, and at the beginning and end of each rollout.

    Without a callback of the agent's own, what SB3 does for one at every step would be wasted: it is overridden here.

    :param scheduler: Of the agent's process
    :param agent: Name of the agent
    :param callback: The user's callback for this agent, if there is one
    """

    def __init__(self, scheduler: "Scheduler", agent: str, callback: BaseCallback | None):
        super().__init__([] if callback is None else [callback])
        self._scheduler, self.agent = scheduler, agent
        #: Looks at the agent's updates, if its ``learn`` has set it
        self.update_check: UpdateCheck | None = None

    def update_locals(self, locals_: dict[str, Any]) -> None:
        for callback in self.callbacks:
            callback.update_locals(locals_)

    def on_step(self) -> bool:
        return self._scheduler.vote(self.agent, super().on_step() if self.callbacks else True)

    def _on_rollout_start(self) -> None:
        if self.update_check is not None:
            # Off-policy algorithms do not train after each rollout
            self.update_check.disarm()
        super()._on_rollout_start()
        self._scheduler.wait(self.agent, ROLLOUT_STARTS)

    def _on_rollout_end(self) -> None:
        super()._on_rollout_end()
        self._scheduler.wait(self.agent, ROLLOUT_ENDED)
        if self.update_check is not None:
            self.update_check.arm()

    def _on_training_end(self) -> None:
        if self.update_check is not None:
            self.update_check.disarm()
        super()._on_training_end()


class Scheduler(ABC):
    """
    Lets the agents of one process take turns and hands out their parts of the joint steps.

    :param num_envs: Number of copies of the environment
    :param observation_spaces: Observation spaces of the agents that may learn in this process
    :param action_spaces: Action spaces of all agents, in order
    :param scripted_action_spaces: Action spaces of the scripted others, in order
    :param render_mode: Of the environment
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
        #: The agents that learn in this process
        self._tasks: dict[str, AgentTask] = {}
        self._main: greenlet | None = None
        self._first: dict[str, np.ndarray] = {}
        self._actions: TeamObs = {}
        self._transitions: dict[str, AgentTransition] = {}
        self._obs: TeamObs = {}
        self._starts: dict[str, np.ndarray] = {}
        # Whether training continues after this step, and whether the agents wait for the answer
        self._continues = self._vote = True
        #: How often agents have ended rollouts and been updated in this ``learn()``
        self.n_rounds = 0
        self.agent_envs = {agent: AgentVecEnv(self, agent) for agent in self.observation_spaces}

    # Called by the agents' environments, callbacks and policies

    @property
    @abstractmethod
    def masks(self) -> dict[str, np.ndarray] | None:
        """The action masks for the current observations, bool ``[num_envs, k]`` by agent; None without masks."""

    def first_observation(self, agent: str) -> np.ndarray:
        """
        Return the agent's observations of the last joint reset, once.

        :param agent: Name of the agent
        :return: ``[num_envs, ...]``
        :raises RuntimeError: If there has been no reset since the agent last asked
        """
        if agent not in self._first:
            raise RuntimeError(
                f"The environment of {agent!r} is reset only together with the others', once at the beginning of Team.learn():"
                " an algorithm that resets it by itself cannot learn in a team, and an agent alone can only predict."
            )
        return self._first.pop(agent)

    def exchange(self, agent: str, actions: np.ndarray) -> AgentStep:
        """
        Wait until all agents have acted and the environment has been stepped.

        :param agent: Name of the agent
        :param actions: Its actions, ``[num_envs, ...]``
        :return: Its part of the joint step
        """
        self._actions[agent] = actions
        self.wait(agent, ACTS)
        return self._transitions.pop(agent).as_step()

    def vote(self, agent: str, continues: bool) -> bool:
        """
        Wait until all agents have counted the step, so that one callback that stops the training stops it for all.

        :param agent: Name of the agent
        :param continues: Whether training continues, as the agent's own callback says
        :return: Whether it continues, as all callbacks say
        """
        if not self._vote:
            return True
        self._continues = self._continues and bool(continues)
        self.wait(agent, COUNTED)
        return self._continues

    def wait(self, agent: str, state: str) -> None:
        """
        Switch to the scheduler until it is the agent's turn again.

        :param agent: Name of the agent
        :param state: What it waits for, one of the constants of this module
        """
        if self._main is None or not self._runs_now(agent):
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
        Tell whether it is the agent's own ``learn()`` that asks its policy for actions, so that it can wait for other agents.

        A callback of the agent's own may ask the policy too, which looks the same from here: the answer is no then.

        :param agent: Name of the agent
        """
        task = self._tasks.get(agent)
        return task is not None and task.callback is None and self._runs_now(agent)

    def _runs_now(self, agent: str) -> bool:
        """Tell whether this is called from within the agent's own ``learn()``."""
        task = self._tasks.get(agent)
        return task is not None and getcurrent() is getattr(task, "coroutine", None)

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Return one image per copy, None where this process cannot draw it."""
        return [None] * self.num_envs

    # Turns

    def _start(self, agents: Iterable[str], rngs: RngSwitch) -> None:
        """Run the agents up to where they begin their first rollouts."""
        self._main = getcurrent()
        for agent in agents:
            task = self._tasks[agent]
            task.coroutine = greenlet(task.learn)
            # Greenlets start with an empty context; the caller's settings (e.g. np.errstate) hold for the agents too
            task.coroutine.gr_context = contextvars.copy_context()
            rngs.to(task.rng)
            self._resume(agent, SyncCallback(self, agent, task.callback))

    def _hand_out(self, transitions: dict[str, AgentTransition]) -> None:
        """Keep the agents' parts of a joint step until it is their turn."""
        self._transitions = transitions
        self._obs = {agent: transition.obs for agent, transition in transitions.items()}
        self._starts = {agent: transition.dones for agent, transition in transitions.items()}

    def _learning(self) -> list[str]:
        return [agent for agent, task in self._tasks.items() if task.state != FINISHED]

    def _start_rollouts(self, agents: Iterable[str], rngs: RngSwitch) -> None:
        """Let those agents that are to begin a rollout choose their first actions."""
        self._take_turns([agent for agent in agents if self._tasks[agent].state == ROLLOUT_STARTS], rngs)

    def _take_turns(self, agents: Iterable[str], rngs: RngSwitch) -> None:
        """Resume the agents one after the other, each with its own random number generators."""
        for agent in agents:
            rngs.to(self._tasks[agent].rng)
            self._resume(agent)

    def _batch_forwards(self, rngs: RngSwitch) -> None:
        """Resume the agents whose policies wait for each other; the first of them makes the forward passes of all."""
        self._take_turns([agent for agent, task in self._tasks.items() if task.state == BATCHES_FORWARD], rngs)

    def _act(self, agent: str, rngs: RngSwitch) -> None:
        """Choose the actions of an agent that has finished learning."""
        task, masks = self._tasks[agent], self.masks
        rngs.to(task.rng)
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
        """End all coroutines, so that their ``finally`` blocks run."""
        running = [(agent, task) for agent, task in self._tasks.items() if getattr(task, "coroutine", None)]
        self._main = None
        for agent, task in running:
            try:
                task.coroutine.throw(GreenletExit)
            except Exception as second:
                if error is not None:
                    add_note(error, f"Agent {agent!r}, stopped because of this, raised {second!r}.")
