"""
Agents whose whole ``learn()`` runs in a worker process, as the main process sees them.

A rollout is SB3's own work for each agent: its policy, its buffer, its bookkeeping. All of that is shared out only if the
agents' loops are. So their models move to a worker when a team begins to learn; all that goes to and fro then is what the
agents are given of each joint step, and what they do. They come back when the team has learned, or when somebody looks at
them, which is asked of the callbacks before (see ``leaves_models_alone``).
"""

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback

from sb3_belief.common.rng import RngState
from sb3_belief.team.parallel.messages import dumps, loads
from sb3_belief.team.parallel.updating import modules_of, pack_of, raise_failure, show, tell, write_buffer, write_changes
from sb3_belief.team.parallel.worker_server import AgentPayload, Command, state_of, wrappers_of
from sb3_belief.team.parallel.workers import Workers
from sb3_belief.vec_env.agent_vec_env import AgentTransition
from sb3_belief.vec_env.team_vec_env import TeamObs

if TYPE_CHECKING:
    from sb3_belief.team.lockstep.joint_loop import JointLoop

# Their callbacks take a model as something that predicts and can be saved
_LIBRARIES = {"stable_baselines3", "sb3_contrib"}
_HOOKS = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")


def leaves_models_alone(callback: BaseCallback | None) -> bool:
    """
    :param callback: of a team
    :return: whether it looks at the team's models through the team's own methods only, and changes nothing in them: those of
        SB3 and sb3-contrib, and what they call
    """
    if callback is None:
        return True
    if isinstance(callback, ConvertCallback):
        return callback.callback is None
    if type(callback).__module__.partition(".")[0] not in _LIBRARIES:
        return False
    called = [
        *getattr(callback, "callbacks", []),
        *(getattr(callback, name, None) for name in ("callback", "callback_on_new_best")),
    ]
    return all(leaves_models_alone(each) for each in called)


def can_learn_elsewhere(model: BaseAlgorithm, scheduler: "JointLoop", agent: str) -> bool:
    """
    :param model: of an agent
    :param hub: in which it learns
    :param agent: its name
    :return: whether its methods are those of its class, nobody has hooked into its networks, and its environment is the one
        that the team has given it
    """
    for owner in (model, model.policy):
        if any(inspect.isroutine(getattr(type(owner), name, None)) for name in vars(owner)):
            return False
    if any(vars(module)[hooks] for _, module in modules_of(model) for hooks in _HOOKS):
        return False
    return model.env is not None and model.env.unwrapped is scheduler.agent_envs[agent]


class RemoteAgents:
    """
    A branch that learns in a worker (see ``lockstep.Branch``).

    :param hub: in which the rest learns
    :param workers: the processes
    :param number: of the worker
    :param models: of the agents, kept as they were before, until they are looked at
    :param streams: what they draw from
    :param learn: runs ``learn()`` of a model with a callback
    """

    def __init__(
        self,
        scheduler: "JointLoop",
        workers: Workers,
        number: int,
        models: Mapping[str, BaseAlgorithm],
        streams: Mapping[str, RngState],
        learn: Callable[..., None],
    ):
        self.agents = list(models)
        self._scheduler, self._workers, self._number = scheduler, workers, number
        self._models, self._streams, self._learn = dict(models), streams, learn
        self._vote = True
        self._is_open, self._is_busy, self._has_moved = False, False, False
        self._answer: dict[str, Any] | None = None

    def _send(self, method: str, *args: Any, is_answered: bool = True) -> None:
        order = Command(method, args, is_answered)
        # The models are more than a simple message
        self._workers.send(self._number, None, dumps(order, {}) if method == "open" else order, ", ".join(self.agents))
        self._is_busy, self._has_moved = is_answered, True

    def _receive(self) -> dict[str, Any]:
        """The answer to the last order, with what was raised in it."""
        answer = loads(self._workers.receive(self._number, None))
        self._is_busy = False
        show(answer)
        for agent, log in answer["log"].items():
            tell(self._models[agent], log)
        return answer

    # For the hub

    def start(self, first: TeamObs, masks: TeamObs | None, vote: bool) -> None:
        scheduler, self._vote = self._scheduler, vote
        scheduler_kwargs = {
            "first": first,
            "masks": self._of_these(masks),
            "vote": vote,
            "num_envs": scheduler.num_envs,
            "observation_spaces": {agent: scheduler.observation_spaces[agent] for agent in self.agents},
            "action_spaces": scheduler.action_spaces,
            "scripted_action_spaces": scheduler.scripted_action_spaces,
            "render_mode": scheduler.render_mode,
        }
        arriving = {agent: self._arriving(agent) for agent in self.agents}
        self._is_open = True
        self._send("open", arriving, self._learn, scheduler_kwargs)

    def _arriving(self, agent: str) -> AgentPayload:
        model = self._models[agent]
        wrappers = [(type(wrapper), state_of(wrapper)) for wrapper in wrappers_of(model.env)]
        return AgentPayload(pack_of(agent, model), wrappers, self._streams[agent])

    def step(self, parts: dict[str, AgentTransition], masks: TeamObs | None) -> None:
        self._send("step", {agent: parts[agent] for agent in self.agents}, self._of_these(masks), is_answered=not self._vote)

    def finish_step(self, continues: bool) -> None:
        self._send("finish_step", continues)

    def end_rollouts(self) -> None:
        self._send("end_rollouts")

    def act(self, agents: Sequence[str]) -> None:
        self._send("act", agents)

    def result(self) -> tuple[dict[str, str], TeamObs]:
        self._wait()
        answer, self._answer = self._answer, None
        if answer is None:
            return {}, {}
        raise_failure(answer)
        return answer["states"], answer["actions"]

    def _wait(self) -> None:
        """Keep what has come of the last order, if nobody has asked for it yet."""
        if self._is_busy:
            self._answer = self._receive()

    def _of_these(self, masks: TeamObs | None) -> TeamObs | None:
        return None if masks is None else {agent: masks[agent] for agent in self.agents if agent in masks}

    # For the team

    def look(self) -> None:
        """
        Make the models here what they are there.

        :raises BaseException: if that cannot be
        """
        if self._is_open and self._has_moved:
            self._wait()
            self._bring("look")
            self._has_moved = False

    def close(self) -> None:
        """
        The same, and nothing is under way there any more.

        :raises BaseException: if that cannot be
        """
        if self._is_open:
            self._is_open = False
            self._wait()
            self._bring("close")

    def _bring(self, method: str) -> None:
        self._send(method)
        answer = self._receive()
        for agent, changes in answer["changes"].items():
            model = self._models[agent]
            write_changes(model, changes["model"])
            for wrapper, state in zip(wrappers_of(model.env), changes["wrappers"], strict=True):
                vars(wrapper).update({key: value for key, value in state.items() if not isinstance(value, spaces.Space)})
            self._streams[agent].become(changes["stream"])
            if changes["buffer"] is not None:
                write_buffer(model, changes["buffer"])
        raise_failure(answer)
