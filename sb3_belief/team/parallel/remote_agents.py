"""Agents whose whole ``learn()`` runs in a worker process, as the main process sees them."""

import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_belief.common.plain_data import PlainData
from sb3_belief.common.processes import uninterrupted
from sb3_belief.common.rng import RngState
from sb3_belief.common.sent_errors import rebuilt_error
from sb3_belief.team.lockstep.joint_loop import JointLoop
from sb3_belief.team.model_parts import wrappers_of
from sb3_belief.team.parallel.messages import Message, dumps, loads
from sb3_belief.team.parallel.model_state import pack, write_state
from sb3_belief.team.parallel.worker_server import AgentPayload, Command, state_of
from sb3_belief.team.parallel.workers import Workers
from sb3_belief.vec_env.agent_vec_env import AgentTransition
from sb3_belief.vec_env.team_vec_env import TeamObs

# For Python's rule that a warning is shown once per place
_shown: dict[Any, Any] = {}
# Commands after which models are as before
_LEARN_NOTHING = ("open", "act", "sync", "close")


class RemoteAgents:
    """
    An agent group (see ``lockstep.agent_group``) that learns in a worker.

    :param loop: The team's loop
    :param workers: The worker processes
    :param number: Number of this group's worker
    :param models: The agents' models. They stay as they were until :meth:`sync` or :meth:`close`
    :param rngs: The agents' random number generators
    :param learn: Runs a model's ``learn()``, called with the model and a callback
    """

    def __init__(
        self,
        loop: JointLoop,
        workers: Workers,
        number: int,
        models: Mapping[str, BaseAlgorithm],
        rngs: Mapping[str, RngState],
        learn: Callable[..., None],
    ):
        self.agents = list(models)
        self._loop, self._workers, self._number = loop, workers, number
        self._models, self._rngs, self._learn = dict(models), rngs, learn
        self._vote = True
        # Whether the models are there, whether a command is being carried out, and whether one was since the last sync
        self._is_open, self._is_busy, self._is_stale = False, False, False
        self._answer: dict[str, Any] | None = None
        # The answer that has been received and not been read yet
        self._message: Message | None = None
        # Whether the agents have learned since their models were last brought here, and whose models have come back since
        self._has_learned, self._returned = False, set[str]()

    @property
    def behind(self) -> list[str]:
        """The agents whose models here are not what they have become in the worker."""
        return [agent for agent in self.agents if self._has_learned and agent not in self._returned]

    def _send(self, method: str, *args: Any, is_answered: bool = True) -> None:
        command = Command(method, args, is_answered)
        # Only models need more than a plain pickle
        message = dumps(command, {}) if method == "open" else command
        # A message that is cut off would be the last one
        with uninterrupted():
            self._workers.send(self._number, message, ", ".join(self.agents))
            self._is_busy, self._is_stale = is_answered, True
            if method not in _LEARN_NOTHING:
                self._has_learned, self._returned = True, set()

    def _receive(self, deadline: float | None = None) -> dict[str, Any]:
        """Return the answer to the last command, after its output, warnings and logs are shown and written here."""
        if self._is_busy:
            self._workers.wait(self._number, deadline)
            with uninterrupted():
                self._message, self._is_busy = self._workers.receive(self._number), False
        assert self._message is not None
        answer, self._message = loads(self._message), None
        if answer["output"]:
            sys.stdout.write(answer["output"])
        for message, category, filename, lineno in answer["warnings"]:
            warnings.warn_explicit(message, category, filename, lineno, registry=_shown)
        for agent, calls in answer["log"].items():
            for method, args, kwargs in calls:
                getattr(self._models[agent].logger, method)(*args, **kwargs)
        return answer

    # For the loop

    def start(self, first: TeamObs, masks: TeamObs | None, vote: bool) -> None:
        loop, self._vote = self._loop, vote
        scheduler_kwargs = {
            "first": first,
            "masks": self._of_these(masks),
            "vote": vote,
            "num_envs": loop.num_envs,
            "observation_spaces": {agent: loop.observation_spaces[agent] for agent in self.agents},
            "action_spaces": loop.action_spaces,
            "scripted_action_spaces": loop.scripted_action_spaces,
            "render_mode": loop.render_mode,
        }
        payloads = {agent: self._payload(agent) for agent in self.agents}
        self._is_open = True
        self._send("open", payloads, self._learn, scheduler_kwargs)

    def _payload(self, agent: str) -> AgentPayload:
        model = self._models[agent]
        wrappers = [(type(wrapper), state_of(wrapper)) for wrapper in wrappers_of(model.env)]
        return AgentPayload(pack(agent, model), wrappers, self._rngs[agent])

    def step(self, transitions: dict[str, AgentTransition], masks: TeamObs | None) -> None:
        own = {agent: transitions[agent] for agent in self.agents}
        self._send("step", own, self._of_these(masks), is_answered=not self._vote)

    def finish_step(self, continues: bool) -> None:
        self._send("finish_step", continues)

    def end_rollouts(self) -> None:
        self._send("end_rollouts")

    def start_rollouts(self) -> None:
        self._send("start_rollouts")

    def restore(self, states: dict[str, PlainData]) -> None:
        self._send("restore", states)

    def act(self, agents: Sequence[str]) -> None:
        self._send("act", agents)

    def result(self) -> tuple[dict[str, str], TeamObs]:
        self._wait()
        answer, self._answer = self._answer, None
        if answer is None:
            return {}, {}
        _raise_failure(answer)
        return answer["states"], answer["actions"]

    def _wait(self, deadline: float | None = None) -> None:
        """Keep the answer to the last command until the loop asks for it."""
        if self._is_busy or self._message is not None:
            self._answer = self._receive(deadline)

    def _of_these(self, masks: TeamObs | None) -> TeamObs | None:
        return None if masks is None else {agent: masks[agent] for agent in self.agents if agent in masks}

    # For the team

    def sync(self) -> None:
        """
        Bring the models here up to date with those in the worker.

        :raises BaseException: If that fails
        """
        if self._is_open and self._is_stale:
            self._wait()
            self._fetch("sync")
            self._is_stale = False

    def close(self, deadline: float | None = None) -> None:
        """
        Bring the models here up to date, rollout buffers included, and end what runs in the worker.

        :param deadline: Until when to wait for it, by ``time.monotonic()``; None to wait without a limit
        :raises BaseException: If that fails
        """
        if self._is_open:
            self._is_open = False
            self._wait(deadline)
            self._fetch("close", deadline)

    def _fetch(self, method: str, deadline: float | None = None) -> None:
        self._send(method)
        answer = self._receive(deadline)
        for agent, payload in answer["payloads"].items():
            model = self._models[agent]
            write_state(model, payload["model"])
            for wrapper, state in zip(wrappers_of(model.env), payload["wrappers"], strict=True):
                vars(wrapper).update({key: value for key, value in state.items() if not isinstance(value, spaces.Space)})
            self._rngs[agent].become(payload["rng"])
            self._returned.add(agent)
        _raise_failure(answer)


def _raise_failure(answer: dict[str, Any]) -> None:
    if answer["error"] is not None:
        raise rebuilt_error(answer["error"])
