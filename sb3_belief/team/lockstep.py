"""
Lockstep: several unmodified SB3 models learn in one joint environment.

SB3's ``learn()`` owns its environment loop, so each runs in a coroutine (a greenlet) of its own. A joint step is

1. every agent has called ``env.step(action)`` and waits;
2. the hub steps the joint environment once and lets each agent go on with its own part of the result, up to the point
   where SB3 calls the callbacks: there each has counted the step, and waits again;
3. the team's callback runs, once, at just the place where SB3 runs callbacks; then each agent is told whether to go on, does
   what its algorithm does with the step (store it, at times train and log) and chooses its next action.

So whoever stops the training, all stop after the same step, and nobody has trained on a step that others have not seen. There
is one thread and one order: the team's, with those that act in another process first. So runs are deterministic. Every
agent draws from a random stream of its own (``RandomStream``), and so does what runs in the hub: the environment in this
process and the team's callbacks.
"""

import contextvars
from copy import deepcopy

import numpy as np
import torch as th
from greenlet import GreenletExit, getcurrent, greenlet
from stable_baselines3.common.vec_env import VecEnv

from sb3_belief.team.agent_vec_env import AgentVecEnv
from sb3_belief.team.members import (
    ACTS,
    ACTS_ELSEWHERE,
    ACTS_HERE,
    COUNTED,
    FINISHED,
    ROLLOUT_ENDED,
    UPDATES,
    UPDATES_HERE,
    Barrier,
    Member,
    Observer,
)
from sb3_belief.team.notes import add_note
from sb3_belief.team.streams import RandomStream, StreamSwitch
from sb3_belief.team.vec_env import TeamObs, TeamStep, TeamVecEnv
from sb3_belief.team.views import AgentStep, TeamViews


class Lockstep:
    """
    The hub between a joint environment and the models of its agents.

    :param env: a ``TeamVecEnv``, or SB3 wrappers around one
    """

    def __init__(self, env: VecEnv):
        team_env = env.unwrapped
        assert isinstance(team_env, TeamVecEnv)
        self.env = env
        self.num_envs = env.num_envs
        self.possible_agents = list(team_env.possible_agents)
        self.observation_spaces = {agent: env.observation_space[agent] for agent in self.possible_agents}  # type: ignore[index]
        # Copies: a model seeds its action space and samples from it
        self.action_spaces = {agent: deepcopy(env.action_space[agent]) for agent in self.possible_agents}  # type: ignore[index]
        self._team_env = team_env
        self.scripted_action_spaces = deepcopy(team_env.scripted_action_spaces)
        self._views = TeamViews(self.possible_agents, self.action_spaces, self.scripted_action_spaces)
        self._members: dict[str, Member] = {}
        self._main: greenlet | None = None
        self._first: dict[str, np.ndarray] = {}
        self._obs: TeamObs = {}
        self._starts: dict[str, np.ndarray] = {}
        self._actions: TeamObs = {}
        self._parts: dict[str, AgentStep] = {}
        self._masks: dict[str, np.ndarray] | None = None
        self._masks_known = False
        self._go_on = True
        self._vote = True
        self._in_round = False
        self.n_steps = 0
        #: How often agents have ended rollouts and been updated in this ``learn()``
        self.n_rounds = 0
        self.agent_envs = {agent: AgentVecEnv(self, agent) for agent in self.possible_agents}

    @property
    def scripted(self) -> dict[str, str]:
        """
        :return: {name of a scripted other: its action space in words}, in order
        """
        return {name: str(space) for name, space in self.scripted_action_spaces.items()}

    # For the agents' environments and callbacks

    @property
    def masks(self) -> dict[str, np.ndarray] | None:
        """
        :return: action masks for the current observations, {agent: bool [num_envs, k]}, or None
        """
        if not self._masks_known:
            self._masks, self._masks_known = self._team_env.action_masks(), True
        return self._masks

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
        return self._parts.pop(agent)

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
        member = self._members.get(agent)
        if self._main is None or member is None or getcurrent() is not member.coroutine:
            raise RuntimeError(
                f"The environment of {agent!r} steps only together with the others': call learn() of the Team,"
                " not of the agent's model."
            )
        # Whether gradients are recorded is a state of the thread, which the agents share
        grad_enabled = th.is_grad_enabled()
        self._main.switch(state)
        if th.is_grad_enabled() != grad_enabled:
            th.set_grad_enabled(grad_enabled)

    def is_round_of(self, agent: str) -> bool:
        """
        :param agent: who is about to be updated
        :return: whether it has ended its rollout and does so in its own ``learn()``, so that it can wait for others who do
        """
        return self._in_round and getcurrent() is self._members[agent].coroutine

    def chooses_actions(self, agent: str) -> bool:
        """
        :param agent: whose policy is asked
        :return: whether its own ``learn()`` asks, so that it can wait for others; where it has a callback that cannot be told
        """
        member = self._members.get(agent)
        return member is not None and member.callback is None and getcurrent() is member.coroutine

    # For the team

    def reset(self) -> None:
        """Reset the joint environment; every agent is then given its first observation in its ``learn()``."""
        self._obs = self.env.reset()  # type: ignore[assignment]
        self._masks_known = False
        self._first = {agent: self._obs[agent] for agent in self.possible_agents}
        self._starts = {agent: np.ones(self.num_envs, dtype=bool) for agent in self.possible_agents}

    def run(self, members: dict[str, Member], observer: Observer, stream: RandomStream) -> bool:
        """
        Let all members learn until each has finished. Who has finished earlier goes on acting.

        :param members: one for each agent
        :param observer: the team
        :param stream: what the environment in this process and the observer draw from
        :return: whether all have seen the last step to its end, so that they can go on from there: not after a callback has
            stopped them (SB3 drops the step at hand), nor if one had finished earlier
        :raises BaseException: whatever one of them raised, after all others were stopped
        """
        self._members = {agent: members[agent] for agent in self.possible_agents}
        self._main = getcurrent()
        self.n_steps, self.n_rounds = 0, 0
        # Without any callback nobody could see who has counted a step, nor stop the others: then the second stop is left out
        self._vote = observer.has_callback or any(member.callback is not None for member in members.values())
        try:
            with StreamSwitch(stream) as streams:
                try:
                    return self._run(observer, stream, streams)
                except BaseException as error:
                    self._stop_all(error)
                    raise
        finally:
            self._main, self._members, self._parts, self._actions, self._in_round = None, {}, {}, {}, False

    def _run(self, observer: Observer, stream: RandomStream, streams: StreamSwitch) -> bool:
        members = self._members
        for agent, member in members.items():
            member.coroutine = greenlet(member.learn)
            # Greenlets start with an empty context; the caller's settings (e.g. np.errstate) hold for the agents too
            member.coroutine.gr_context = contextvars.copy_context()
            streams.to(member.stream)
            self._resume(agent, Barrier(self, agent, member.callback))
        # Who has ended a rollout since the team's last one ended
        ended: set[str] = set()
        learning, all_together = self._learning(), False
        streams.to(stream)
        observer.on_rollout_start()
        while learning:
            # Who acts in another process has its step first, so that the process is busy while others here have theirs
            learning.sort(key=lambda agent: members[agent].state != ACTS_ELSEWHERE)
            self._await_actions(streams)
            all_together = len(learning) == len(members)
            if not all_together:
                for agent, member in members.items():
                    if member.state == FINISHED:
                        streams.to(member.stream)
                        self._act(agent)
            streams.to(stream)
            actions = {agent: np.asarray(self._actions[agent]) for agent in members}
            step = self._step(actions)
            for agent in learning if self._vote else ():
                # Only the user's callbacks may draw random numbers here; without them the exchange of streams is spared
                if members[agent].callback is not None:
                    streams.to(members[agent].stream)
                self._resume(agent)
            streams.to(stream)
            self._go_on = observer.on_step(actions, step) and self._go_on
            all_act = True
            for agent in learning:
                member = members[agent]
                if member.state == COUNTED or not self._vote:
                    streams.to(member.stream)
                    self._resume(agent)
                all_act = all_act and member.state in (ACTS, ACTS_HERE, ACTS_ELSEWHERE)
            if not all_act:
                if any(member.state == ROLLOUT_ENDED for member in members.values()):
                    self._end_rollouts(ended, observer, stream, streams)
                learning = self._learning()
        return self._go_on and all_together

    def _await_actions(self, streams: StreamSwitch) -> None:
        """First those act who do so in this process, together where they can, while others are busy."""
        for state in (ACTS_HERE, ACTS_ELSEWHERE):
            for agent, member in self._members.items():
                if member.state == state:
                    streams.to(member.stream)
                    self._resume(agent)

    def _learning(self) -> list[str]:
        return [agent for agent, member in self._members.items() if member.state != FINISHED]

    def _end_rollouts(self, ended: set[str], observer: Observer, stream: RandomStream, streams: StreamSwitch) -> None:
        now = [agent for agent, member in self._members.items() if member.state == ROLLOUT_ENDED]
        ended.update(now)
        streams.to(stream)
        team_ended = ended.issuperset(self._learning())
        if team_ended:
            ended.clear()
            observer.on_rollout_end()
        # Whoever is updated goes on to its next action at once
        self._in_round, self.n_rounds = True, self.n_rounds + 1
        turns = now
        while turns:
            for agent in turns:
                streams.to(self._members[agent].stream)
                self._resume(agent)
            # With updates in several processes: first who is updated here, while the workers are busy, then all in their order
            here = [agent for agent in now if self._members[agent].state == UPDATES_HERE]
            turns = here or [agent for agent in now if self._members[agent].state == UPDATES]
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
        parts = self._views.split(actions, step)
        self._parts = dict(zip(self.possible_agents, parts, strict=True))
        self._obs = step[0]
        self._starts = {agent: part[2] for agent, part in self._parts.items()}
        return step

    def _act(self, agent: str) -> None:
        masks = self.masks
        mask = None if masks is None else masks.get(agent)
        self._actions[agent] = self._members[agent].act(self._obs[agent], self._starts[agent], mask)

    def _resume(self, agent: str, *args: object) -> None:
        member = self._members[agent]
        grad_enabled = th.is_grad_enabled()
        try:
            state = member.coroutine.switch(*args)
        except Exception as error:
            add_note(error, f"Raised by agent {agent!r}.")
            raise
        finally:
            if th.is_grad_enabled() != grad_enabled:
                th.set_grad_enabled(grad_enabled)
        member.state = FINISHED if member.coroutine.dead else state

    def _stop_all(self, error: BaseException) -> None:
        """End the coroutines so that their ``finally`` blocks run, and say when it happened."""
        running = [(agent, member) for agent, member in self._members.items() if getattr(member, "coroutine", None)]
        self._main = None
        for agent, member in running:
            try:
                member.coroutine.throw(GreenletExit)
            except Exception as second:
                add_note(error, f"Agent {agent!r}, stopped because of this, raised {second!r}.")
        add_note(
            error, f"The team was stopped at joint step {self.n_steps} of this learn(); its models keep what they learned."
        )
