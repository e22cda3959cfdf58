"""
JointLoop: several unmodified SB3 models learn in one joint environment.

A joint step is

1. every agent has called ``env.step(action)`` and waits;
2. the hub steps the joint environment once and lets each agent go on with its own part of the result, up to the point
   where SB3 calls the callbacks: there each has counted the step, and waits again;
3. the team's callback runs, once, at just the place where SB3 runs callbacks; then each agent is told whether to go on, does
   what its algorithm does with the step (store it, at times train and log) and chooses its next action.

So whoever stops the training, all stop after the same step, and nobody has trained on a step that others have not seen. In
each process there is one thread and one order: the team's. So runs are deterministic. Every agent draws from a random stream
of its own (``RngState``), and so does what runs in the hub: the environment in this process and the team's callbacks.
"""

from collections.abc import Iterable, Sequence
from copy import deepcopy
from typing import Protocol

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_belief.common.exceptions import add_note
from sb3_belief.common.rng import RngState, RngSwitch
from sb3_belief.team.lockstep.agent_task import (
    ACTS,
    BATCHES_FORWARD,
    COUNTED,
    FINISHED,
    ROLLOUT_ENDED,
    UPDATES,
    UPDATES_HERE,
    AgentTask,
    Observer,
)
from sb3_belief.team.lockstep.scheduler import Scheduler
from sb3_belief.vec_env.agent_step import AgentTransition, TransitionSplitter
from sb3_belief.vec_env.team_vec_env import TeamObs, TeamStep, TeamVecEnv


class AgentGroup(Protocol):
    """
    Agents of the team whose models learn in another process, in lockstep with those here.

    :param agents: who they are
    """

    agents: list[str]

    def start(self, first: TeamObs, masks: TeamObs | None, vote: bool) -> None:
        """
        Let them go up to their first actions.

        :param first: their observations, if the environment was reset
        :param masks: of all agents, if there are any
        :param vote: whether there is something between counting a step and what follows
        """

    def step(self, parts: dict[str, AgentTransition], masks: TeamObs | None) -> None:
        """
        Let them count the step and, where there is no vote, go on.

        :param parts: of all agents
        :param masks: of all agents, if there are any
        """

    def go_on(self, go_on: bool) -> None:
        """
        Let them do the rest.

        :param go_on: the result of the vote
        """

    def end_rollouts(self) -> None:
        """Let those who have ended a rollout be updated and go on."""

    def act(self, agents: Sequence[str]) -> None:
        """
        :param agents: who have finished learning, and are to act once more
        """

    def result(self) -> tuple[dict[str, str], TeamObs]:
        """
        :return: {agent: why it waits} and {agent: what it does}, of those who have gone on since the last time
        :raises BaseException: what one of them raised
        """


class JointLoop(Scheduler):
    """
    The hub between a joint environment and the models of its agents.

    :param env: a ``TeamVecEnv``, or SB3 wrappers around one
    """

    def __init__(self, env: VecEnv):
        team_env = env.unwrapped
        assert isinstance(team_env, TeamVecEnv)
        self.env = env
        self.possible_agents = list(team_env.possible_agents)
        self._team_env = team_env
        self._masks: dict[str, np.ndarray] | None = None
        self._masks_known = False
        self._remote_groups: Sequence[AgentGroup] = ()
        #: Who learns in them
        self._elsewhere: set[str] = set()
        self._in_round = False
        self.n_steps = 0
        super().__init__(
            env.num_envs,
            {agent: env.observation_space[agent] for agent in self.possible_agents},  # type: ignore[index]
            # Copies: a model seeds its action space and samples from it
            {agent: deepcopy(env.action_space[agent]) for agent in self.possible_agents},  # type: ignore[index]
            deepcopy(team_env.scripted_action_spaces),
            env.render_mode,
        )
        self._views = TransitionSplitter(self.possible_agents, self.action_spaces, self.scripted_action_spaces)

    @property
    def scripted(self) -> dict[str, str]:
        """
        :return: {name of a scripted other: its action space in words}, in order
        """
        return {name: str(space) for name, space in self.scripted_action_spaces.items()}

    @property
    def masks(self) -> dict[str, np.ndarray] | None:
        if not self._masks_known:
            self._masks, self._masks_known = self._team_env.action_masks(), True
        return self._masks

    def get_images(self) -> Sequence[np.ndarray | None]:
        return self.env.get_images()

    def is_round_of(self, agent: str) -> bool:
        """
        :param agent: who is about to be updated
        :return: whether it has ended its rollout and does so in its own ``learn()``, so that it can wait for others who do
        """
        return self._in_round and self._is_in_turn(agent)

    def reset(self) -> None:
        """Reset the joint environment; every agent is then given its first observation in its ``learn()``."""
        self._obs = self.env.reset()  # type: ignore[assignment]
        self._masks_known = False
        self._first = {agent: self._obs[agent] for agent in self.possible_agents}
        self._starts = {agent: np.ones(self.num_envs, dtype=bool) for agent in self.possible_agents}

    def run(
        self, tasks: dict[str, AgentTask], observer: Observer, stream: RngState, remote_groups: Sequence[AgentGroup] = ()
    ) -> bool:
        """
        Let all members learn until each has finished. Who has finished earlier goes on acting.

        :param members: one for each agent
        :param observer: the team
        :param stream: what the environment in this process and the observer draw from
        :param branches: in which some of the agents learn
        :return: whether all have seen the last step to its end, so that they can go on from there: not after a callback has
            stopped them (SB3 drops the step at hand), nor if one had finished earlier
        :raises BaseException: whatever one of them raised, after all others were stopped
        """
        self._tasks = {agent: tasks[agent] for agent in self.possible_agents}
        self._remote_groups, self._elsewhere = remote_groups, {agent for group in remote_groups for agent in group.agents}
        self.n_steps, self.n_rounds = 0, 0
        # Without any callback nobody could see who has counted a step, nor stop the others: then the second stop is left out
        self._vote = observer.has_callback or any(task.callback is not None for task in tasks.values())
        try:
            with RngSwitch(stream) as streams:
                try:
                    return self._run(observer, stream, streams)
                except BaseException as error:
                    self._stop_all(error)
                    add_note(
                        error,
                        f"The team was stopped at joint step {self.n_steps} of this learn();"
                        " its models keep what they learned.",
                    )
                    raise
        finally:
            self._main, self._tasks, self._in_round = None, {}, False
            self._remote_groups, self._elsewhere = (), set()
            self._parts, self._actions = {}, {}

    def _run(self, observer: Observer, stream: RngState, streams: RngSwitch) -> bool:
        tasks = self._tasks
        for group in self._remote_groups:
            first = {agent: self._first.pop(agent) for agent in group.agents if agent in self._first}
            group.start(first, self.masks, self._vote)
        self._start(self._here(tasks), streams)
        self._join()
        # Who has ended a rollout since the team's last one ended
        ended: set[str] = set()
        learning, all_together = self._learning(), False
        streams.to(stream)
        observer.on_rollout_start()
        while learning:
            self._await_actions(streams)
            all_together = len(learning) == len(tasks)
            if not all_together:
                self._let_finished_act(streams)
            streams.to(stream)
            actions = {agent: np.asarray(self._actions[agent]) for agent in tasks}
            step = self._step(actions)
            learning_here = self._here(learning)
            for agent in learning_here if self._vote else ():
                # Only the user's callbacks may draw random numbers here; without them the exchange of streams is spared
                if tasks[agent].callback is not None:
                    streams.to(tasks[agent].stream)
                self._resume(agent)
            streams.to(stream)
            self._go_on = observer.on_step(actions, step) and self._go_on
            for group in self._remote_groups if self._vote else ():
                group.go_on(self._go_on)
            self._take_turns([a for a in learning_here if tasks[a].state == COUNTED or not self._vote], streams)
            if self._remote_groups:
                if self._all_act(learning_here):
                    self._await_actions(streams)
                self._join()
            if not self._all_act(learning):
                if any(task.state == ROLLOUT_ENDED for task in tasks.values()):
                    self._end_rollouts(ended, observer, stream, streams)
                learning = self._learning()
        return self._go_on and all_together

    def _here(self, agents: Iterable[str]) -> list[str]:
        return [agent for agent in agents if agent not in self._elsewhere]

    def _all_act(self, agents: Sequence[str]) -> bool:
        return all(self._tasks[agent].state in (ACTS, BATCHES_FORWARD) for agent in agents)

    def _join(self) -> None:
        """Wait for what the agents elsewhere do."""
        for group in self._remote_groups:
            states, actions = group.result()
            self._actions.update(actions)
            for agent, state in states.items():
                self._tasks[agent].state = state

    def _let_finished_act(self, streams: RngSwitch) -> None:
        finished = [agent for agent, task in self._tasks.items() if task.state == FINISHED]
        for group in self._remote_groups:
            theirs = [agent for agent in finished if agent in group.agents]
            if theirs:
                group.act(theirs)
        for agent in self._here(finished):
            self._act(agent, streams)
        self._join()

    def _end_rollouts(self, ended: set[str], observer: Observer, stream: RngState, streams: RngSwitch) -> None:
        now = [agent for agent, task in self._tasks.items() if task.state == ROLLOUT_ENDED]
        ended.update(now)
        streams.to(stream)
        team_ended = ended.issuperset(self._learning())
        if team_ended:
            ended.clear()
            observer.on_rollout_end()
        # Whoever is updated goes on to its next action at once
        self._in_round, self.n_rounds = True, self.n_rounds + 1
        for group in self._remote_groups:
            if not set(now).isdisjoint(group.agents):
                group.end_rollouts()
        turns = now = self._here(now)
        while turns:
            self._take_turns(turns, streams)
            # With updates in several processes: first who is updated here, while the workers are busy, then all in their order
            here = [agent for agent in now if self._tasks[agent].state == UPDATES_HERE]
            turns = here or [agent for agent in now if self._tasks[agent].state == UPDATES]
        self._join()
        self._in_round = False
        streams.to(stream)
        learning = self._learning()
        observer.on_round_end(learning)
        if team_ended and learning:
            observer.on_rollout_start()

    def _step(self, actions: TeamObs) -> TeamStep:
        self.n_steps += 1
        self._go_on = True
        step: TeamStep = self.env.step(actions)  # type: ignore[arg-type, assignment]
        self._masks_known = False
        parts = self._views.parts(actions, step)
        self._hand_out(dict(zip(self.possible_agents, parts, strict=True)))
        for group in self._remote_groups:
            group.step(self._parts, self.masks)
        return step
