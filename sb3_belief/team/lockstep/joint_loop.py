"""
Lockstep: several unmodified SB3 models learn in one joint environment.

A joint step is

1. every agent has called ``env.step(action)`` and waits;
2. the loop steps the joint environment once and resumes each agent with its own part of the result, up to the point where SB3
   calls the callbacks: there each has counted the step, and waits again;
3. the team's callback runs, once, at just the place where SB3 runs callbacks; then each agent learns whether training
   continues, does what its algorithm does with the step (store it, at times train and log) and chooses its next action.

So a callback that stops the training stops all agents after the same step, and no agent has trained on a step that others have
not seen. Each agent draws random numbers from generators of its own (``RngState``); the environment in this process and the
team's callbacks share another one.
"""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from copy import deepcopy
from typing import Any, Protocol

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv

from sb3_belief.common.exceptions import add_note
from sb3_belief.common.plain_data import PlainData
from sb3_belief.common.rng import RngState, RngSwitch
from sb3_belief.team.lockstep.agent_group import AgentGroup
from sb3_belief.team.lockstep.scheduler import (
    ACTS,
    BATCHES_FORWARD,
    COUNTED,
    FINISHED,
    ROLLOUT_ENDED,
    ROLLOUT_STARTS,
    AgentTask,
    Scheduler,
)
from sb3_belief.team.lockstep.wrapper_check import WrapperCheck
from sb3_belief.team.logs import TeamLog
from sb3_belief.team.masks import MaskCheck
from sb3_belief.vec_env.agent_vec_env import TransitionSplitter
from sb3_belief.vec_env.team_vec_env import TeamObs, TeamStep, TeamVecEnv


class LearningTeam(Protocol):
    """What :class:`TeamProgress` counts and logs for, and what callbacks get as their model: a ``Team``."""

    num_timesteps: int
    ep_info_buffer: deque[dict[str, Any]]
    ep_success_buffer: deque[bool]

    @property
    def logger(self) -> Logger:
        """The team's logger."""

    def dump_logs(self) -> None:
        """Write the team's table."""


class TeamProgress:
    """
    What happens between the agents while a team learns: the team's callback, its counters and its log.

    All of it draws from the team's own random number generators.

    :param team: The team
    :param callback: Its callback
    :param log: Its loggers
    """

    def __init__(self, team: LearningTeam, callback: BaseCallback, log: TeamLog):
        self._team, self._callback, self._log = team, callback, log
        #: Whether there is a callback that may look at the agents, or stop the training
        self.has_callback = not (isinstance(callback, ConvertCallback) and callback.callback is None)
        callback.init_callback(team)  # type: ignore[arg-type]

    def on_training_start(self, locals_: dict[str, Any]) -> None:
        """
        Tell the callback that training starts.

        :param locals_: What callbacks find in ``self.locals``
        """
        self._callback.on_training_start(locals_, globals())

    def on_rollout_start(self) -> None:
        """Tell the callback, before the first step of a rollout."""
        self._callback.on_rollout_start()

    def on_step(self, actions: TeamObs, step: TeamStep) -> bool:
        """
        Count a joint step and run the callback.

        :param actions: The actions of this step, by agent
        :param step: What the joint environment returned
        :return: Whether training continues
        """
        obs, rewards, dones, infos = step
        self._team.num_timesteps += len(dones)
        continues = True
        if self.has_callback:
            locals_ = {"actions": actions, "new_obs": obs, "rewards": rewards, "dones": dones, "infos": infos}
            self._callback.update_locals(locals_)
            continues = self._callback.on_step()
        if dones.any():
            for info in infos:
                if "episode" in info:
                    # Who the partner was is for the log, and never in what the agents are given of the episode
                    met = {"partner": info["partner"]} if isinstance(info.get("partner"), str) else {}
                    self._team.ep_info_buffer.append({**info["episode"], **met})
                    if "is_success" in info:
                        self._team.ep_success_buffer.append(info["is_success"])
        return continues

    def on_rollout_end(self) -> None:
        """Tell the callback when all agents that still learn have ended a rollout, before they train on it."""
        self._callback.on_rollout_end()

    def on_round_end(self, learning: list[str]) -> None:
        """
        Write the team's table when agents that ended rollouts have trained on them.

        :param learning: The agents that still learn
        """
        if self._log.complete(learning):
            self._log.record_means(self._team.logger)
            self._team.dump_logs()

    def on_training_end(self) -> None:
        """Tell the callback that training has ended."""
        self._callback.on_training_end()


class JointLoop(Scheduler):
    """
    Steps a joint environment with the actions of all agents, and schedules the agents in between.

    :param env: A ``TeamVecEnv``, or SB3 wrappers around one
    """

    def __init__(self, env: VecEnv):
        team_env = env.unwrapped
        assert isinstance(team_env, TeamVecEnv)
        self.env, self.team_env = env, team_env
        self.possible_agents = list(team_env.possible_agents)
        self._wrapper_check = WrapperCheck(env)
        #: Watches the first steps for actions that masks forbid
        self.mask_check: MaskCheck | None = None
        self._masks: dict[str, np.ndarray] | None = None
        self._masks_known = False
        self._groups: Sequence[AgentGroup] = ()
        self._rngs: RngSwitch | None = None
        #: Called once, where all agents begin their first rollout
        self.at_first_rollout: Callable[[], None] | None = None
        #: The agents that learn in these groups
        self._elsewhere: set[str] = set()
        self.n_steps = 0
        super().__init__(
            env.num_envs,
            {agent: env.observation_space[agent] for agent in self.possible_agents},  # type: ignore[index]
            # Copies: a model seeds its action space and samples from it
            {agent: deepcopy(env.action_space[agent]) for agent in self.possible_agents},  # type: ignore[index]
            deepcopy(team_env.scripted_action_spaces),
            env.render_mode,
        )
        self._splitter = TransitionSplitter(self.possible_agents, self.action_spaces, self.scripted_action_spaces)

    @property
    def scripted(self) -> dict[str, str]:
        """The action space of each scripted other as text, in order."""
        return {name: str(space) for name, space in self.scripted_action_spaces.items()}

    @property
    def masks(self) -> dict[str, np.ndarray] | None:
        if not self._masks_known:
            self._masks, self._masks_known = self.team_env.action_masks(), True
        return self._masks

    def get_images(self) -> Sequence[np.ndarray | None]:
        return self.env.get_images()

    def reset(self) -> None:
        """Reset the joint environment; each agent gets its first observation in its ``learn()``."""
        self._obs = self.env.reset()  # type: ignore[assignment]
        self._masks_known = False
        self._first = {agent: self._obs[agent] for agent in self.possible_agents}
        self._starts = {agent: np.ones(self.num_envs, dtype=bool) for agent in self.possible_agents}

    # The exact state (team/exact)

    @property
    def begins_rollouts(self) -> bool:
        """Whether all agents are about to begin a rollout."""
        return bool(self._tasks) and all(task.state == ROLLOUT_STARTS for task in self._tasks.values())

    @property
    def last(self) -> tuple[TeamObs, dict[str, np.ndarray]]:
        """The present observations and whether episodes have begun with them, by agent."""
        return dict(self._obs), dict(self._starts)

    @property
    def callbacks(self) -> dict[str, BaseCallback]:
        """The agents' own callbacks."""
        return {agent: task.callback for agent, task in self._tasks.items() if task.callback is not None}

    def continue_from(self, obs: TeamObs, starts: dict[str, np.ndarray]) -> None:
        """
        Go on with episodes that are under way.

        :param obs: The present observations by agent
        :param starts: Whether episodes have begun with them, by agent
        """
        self._obs, self._starts, self._first, self._masks_known = obs, starts, {}, False

    def put_rngs_aside(self) -> AbstractContextManager[None]:
        """Within the block no random number generators of the team are the current ones. Only while agents learn."""
        assert self._rngs is not None
        return self._rngs.put_aside()

    def restore_groups(self, states: dict[str, PlainData]) -> None:
        """
        Put the states of the agents back that learn in other processes.

        :param states: Of all agents
        """
        for group in self._groups:
            group.restore({agent: states[agent] for agent in group.agents})
        self._join()

    def run(
        self, tasks: dict[str, AgentTask], progress: TeamProgress, rng: RngState, groups: Sequence[AgentGroup] = ()
    ) -> bool:
        """
        Let all agents learn until each has finished. Agents that finish earlier continue to act.

        :param tasks: One for each agent
        :param progress: The team's callback, counters and log
        :param rng: Random number generators of the environment in this process and of ``progress``
        :param groups: The agents that learn in other processes
        :return: Whether all agents have completed the last step, so that they can continue from there: not after a callback
            has stopped them (SB3 drops the step at hand), nor if one of them finished earlier than others
        :raises BaseException: Whatever an agent raised, after all others were stopped
        """
        self._tasks = {agent: tasks[agent] for agent in self.possible_agents}
        self._groups, self._elsewhere = groups, {agent for group in groups for agent in group.agents}
        self.n_steps, self.n_rounds = 0, 0
        # Without any callback nothing can see which agents have counted a step, nor stop them: the second stop is left out
        self._vote = progress.has_callback or any(task.callback is not None for task in tasks.values())
        try:
            with RngSwitch(rng) as rngs:
                self._rngs = rngs
                try:
                    return self._run(progress, rng, rngs)
                except BaseException as error:
                    self._stop_all(error)
                    add_note(
                        error,
                        f"The team was stopped at joint step {self.n_steps} of this learn();"
                        " its models keep what they learned.",
                    )
                    raise
        finally:
            self._main, self._rngs, self._tasks = None, None, {}
            self._groups, self._elsewhere = (), set()
            self._transitions, self._actions = {}, {}

    def _run(self, progress: TeamProgress, rng: RngState, rngs: RngSwitch) -> bool:
        tasks = self._tasks
        for group in self._groups:
            first = {agent: self._first.pop(agent) for agent in group.agents if agent in self._first}
            group.start(first, self.masks, self._vote)
        self._start(self._in_this_process(tasks), rngs)
        self._join()
        # The agents that have ended a rollout since the last rollout of the whole team ended
        ended: set[str] = set()
        learning, all_together = self._learning(), False
        rngs.to(rng)
        if self.at_first_rollout is not None:
            self.at_first_rollout()
        self._start_rollout(progress)
        self._begin_rollouts(rngs)
        while learning:
            self._batch_forwards(rngs)
            all_together = len(learning) == len(tasks)
            if not all_together:
                self._let_finished_act(rngs)
            rngs.to(rng)
            actions = {agent: np.asarray(self._actions[agent]) for agent in tasks}
            step = self._step(actions)
            learning_here = self._in_this_process(learning)
            for agent in learning_here if self._vote else ():
                # Up to the vote only the user's callbacks may draw random numbers; without them nothing need be exchanged
                if tasks[agent].callback is not None:
                    rngs.to(tasks[agent].rng)
                self._resume(agent)
            rngs.to(rng)
            self._continues = progress.on_step(actions, step) and self._continues
            for group in self._groups if self._vote else ():
                group.finish_step(self._continues)
            self._take_turns([a for a in learning_here if tasks[a].state == COUNTED or not self._vote], rngs)
            if self._groups:
                if self._all_act(learning_here):
                    # While the groups are busy, too
                    self._batch_forwards(rngs)
                self._join()
            if not self._all_act(learning):
                if any(task.state == ROLLOUT_ENDED for task in tasks.values()):
                    self._end_rollouts(ended, progress, rng, rngs)
                learning = self._learning()
        return self._continues and all_together

    def _in_this_process(self, agents: Iterable[str]) -> list[str]:
        return [agent for agent in agents if agent not in self._elsewhere]

    def _all_act(self, agents: Sequence[str]) -> bool:
        return all(self._tasks[agent].state in (ACTS, BATCHES_FORWARD) for agent in agents)

    def _join(self) -> None:
        """Wait for the agents that learn elsewhere."""
        for group in self._groups:
            states, actions = group.result()
            self._actions.update(actions)
            for agent, state in states.items():
                self._tasks[agent].state = state

    def _let_finished_act(self, rngs: RngSwitch) -> None:
        finished = [agent for agent, task in self._tasks.items() if task.state == FINISHED]
        for group in self._groups:
            theirs = [agent for agent in finished if agent in group.agents]
            if theirs:
                group.act(theirs)
        for agent in self._in_this_process(finished):
            self._act(agent, rngs)
        self._join()

    def _end_rollouts(self, ended: set[str], progress: TeamProgress, rng: RngState, rngs: RngSwitch) -> None:
        now = [agent for agent, task in self._tasks.items() if task.state == ROLLOUT_ENDED]
        ended.update(now)
        rngs.to(rng)
        team_ended = ended.issuperset(self._learning())
        if team_ended:
            ended.clear()
            progress.on_rollout_end()
        self.n_rounds += 1
        for group in self._groups:
            if not set(now).isdisjoint(group.agents):
                group.end_rollouts()
        self._take_turns(self._in_this_process(now), rngs)
        self._join()
        rngs.to(rng)
        learning = self._learning()
        progress.on_round_end(learning)
        if team_ended and learning:
            self._start_rollout(progress)
        self._begin_rollouts(rngs)

    def _start_rollout(self, progress: TeamProgress) -> None:
        progress.on_rollout_start()
        # After the callback, which may save the team: what is saved then begins this rollout when it goes on
        self.team_env.begin_rollout()

    def _begin_rollouts(self, rngs: RngSwitch) -> None:
        """Let the agents that are to begin a rollout choose their first actions."""
        starting = {agent for agent, task in self._tasks.items() if task.state == ROLLOUT_STARTS}
        for group in self._groups:
            if not starting.isdisjoint(group.agents):
                group.start_rollouts()
        self._start_rollouts(self._in_this_process(self._tasks), rngs)
        self._join()

    def _step(self, actions: TeamObs) -> TeamStep:
        self.n_steps += 1
        self._continues = True
        if self.mask_check is None or self.mask_check.is_done:
            step: TeamStep = self.env.step(actions)  # type: ignore[arg-type, assignment]
        else:
            step = self.mask_check.step(self.env.step, actions, self.masks)
        if self._wrapper_check.wrappers:
            self._wrapper_check.check(step)
        self._masks_known = False
        transitions = self._splitter.transitions(actions, step, lambda: self.masks)
        self._hand_out(dict(zip(self.possible_agents, transitions, strict=True)))
        for group in self._groups:
            group.step(self._transitions, self.masks)
        return step
