"""
Saving the exact state of a team in training, and going on from it.

It is taken where all agents begin a rollout: each has been updated, none has chosen its next action. A training that goes on
from there runs up to the same place, where everything is put back, over whatever was drawn on the way.
"""

import warnings
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from sb3_belief.common.file_names import file_name
from sb3_belief.common.plain_data import NotPlainError, PlainData, encode
from sb3_belief.common.rng import RngState, RngSwitch
from sb3_belief.common.safe_files.trust import UNTRUSTED
from sb3_belief.team.agent_models import AgentModels, env_seed
from sb3_belief.team.checkpoint import SavedTeam
from sb3_belief.team.exact.agent_state import read_agent_state, write_agent_state
from sb3_belief.team.exact.counted import callback_states, have_classes, restore_callbacks, restore_wrappers, wrapper_states
from sb3_belief.team.lockstep.joint_loop import JointLoop
from sb3_belief.team.logs import TeamLog

_TEAM = "exact/team"
_COUNTERS = ("num_timesteps", "_iterations", "ep_info_buffer", "ep_success_buffer")
_ENTRIES = frozenset("in_rollout n_envs counters env wrappers last rng callbacks agent_callbacks log monitor".split())


class ExactState(NamedTuple):
    """
    The exact state of a team, as plain data.

    :param team: Environment, counters, callbacks, logs and the team's own random numbers
    :param agents: The states of its agents
    """

    team: PlainData
    agents: dict[str, PlainData]

    def parts(self) -> dict[str, PlainData]:
        """Return the state as the parts of a team's file."""
        return {_TEAM: self.team, **{_part(agent): state for agent, state in self.agents.items()}}


def _part(agent: str) -> str:
    return f"exact/agents/{file_name(agent)}"


def check_exact_load(env: Any, settings: Mapping[str, Any]) -> None:
    """
    Check that a team that is to go on exactly is loaded as it was.

    :param env: The environment
    :param settings: Arguments that would replace saved ones
    :raises ValueError: If there is no environment, or are such arguments
    """
    if env is None:
        raise ValueError("A training goes on in an environment: Team.load(path, env=env, exact=True), made as it was before.")
    if settings:
        raise ValueError(
            f"A training that goes on exactly keeps its settings, but load() was given {sorted(settings)}: leave them out, or"
            " load the team without exact=True."
        )


class ExactTraining:
    """
    Reads a team's exact state, and puts one back when the team begins to learn.

    :param team: The team
    :param agents: Its models with what belongs to them
    :param rng: The team's own random number generators
    """

    def __init__(self, team: Any, agents: AgentModels, rng: RngState):
        self._team, self._models, self._rngs, self._rng = team, agents.models, agents.rngs, rng
        self._pending: dict[str, Any] | None = None
        self._pending_agents: dict[str, PlainData] = {}
        self._callback: BaseCallback | None = None
        self._warned = False
        self._needs_reset: bool | None = None

    # Reading

    def read(self, loop: JointLoop | None, learning: bool, can_continue: bool, log: TeamLog | None) -> ExactState:
        """
        Return the exact state. An environment whose state cannot be read begins new episodes, in this training too.

        :param loop: The team's loop
        :param learning: Whether the team is learning
        :param can_continue: Whether it could go on with the episodes at hand
        :param log: Its log, if there is one
        :return: The state
        :raises ValueError: If some agents are in the middle of a rollout, or if there is no environment
        """
        if loop is None or self._pending is not None or not (loop.begins_rollouts if learning else can_continue):
            raise ValueError(
                "The exact state of a team can be saved where all its agents begin a rollout: in the _on_rollout_start() of a"
                " callback of the team, as long as no agent has finished before others and the agents' rollouts begin at the"
                " same step; or after a learn() that no callback has stopped. Use save(path) without exact=True elsewhere."
            )
        models = self._team.agents
        with nullcontext() if learning else RngSwitch(self._rng):
            env, was_reset = self._read_env(loop, models)
        with loop.put_rngs_aside() if learning else nullcontext():
            agents = {agent: read_agent_state(model, self._rngs[agent]) for agent, model in models.items()}
            team = {
                "in_rollout": learning,
                "n_envs": loop.num_envs,
                "counters": {name: getattr(self._team, name) for name in _COUNTERS},
                "env": env,
                "wrappers": wrapper_states(loop.env),
                "last": loop.last,
                "rng": self._rng.get(),
                "callbacks": None if self._callback is None else callback_states(self._callback),
                "agent_callbacks": {agent: callback_states(each) for agent, each in loop.callbacks.items()},
                "log": None if log is None else log.state(self._team.num_timesteps),
                "monitor": loop.team_env.monitor_state(),
            }
        if was_reset and learning:
            loop.restore_groups(agents)
        return ExactState(encode(team, lambda module: True, "the team"), agents)

    def _read_env(self, loop: JointLoop, models: Mapping[str, BaseAlgorithm]) -> tuple[dict[str, Any], bool]:
        try:
            return loop.team_env.exact_state(), False
        except NotPlainError as error:
            if not self._warned:
                self._warned = True
                warnings.warn(
                    "The state of the environment cannot be saved, so that all its copies begin new episodes with each exact"
                    f" checkpoint, seeded by the team's seed and the step. {error}"
                )
        seed = env_seed(self._team.seed or 0, purpose=2, step=self._team.num_timesteps)
        loop.env.seed(seed)
        loop.reset()
        for model in models.values():
            _begin_episodes(model)
        return {"seed": seed}, True

    def needs_reset(self, loop: JointLoop) -> bool:
        """
        Tell whether the environment's state cannot be saved.

        :param loop: The team's loop, after a reset
        """
        if self._needs_reset is None:
            try:
                encode(loop.team_env.exact_state(), lambda module: True)
                self._needs_reset = False
            except NotPlainError:
                self._needs_reset = True
        return self._needs_reset

    # Going on

    def load(self, saved: SavedTeam, loop: JointLoop | None) -> None:
        """
        Keep a state until the team begins to learn.

        :param saved: The contents of a team's file
        :param loop: The team's loop
        :raises ValueError: If there is no exact state among them, or one of another number of copies, or no environment
        """
        assert loop is not None
        names = {agent: _part(agent) for agent in self._team.possible_agents}
        missing = [name for name in (_TEAM, *names.values()) if name not in saved.contents]
        if missing:
            raise ValueError(
                "This file does not hold the exact state of a training: it was saved without exact=True. Load it without, and"
                " the training goes on with new episodes and other random numbers."
            )
        state = saved.part(_TEAM, UNTRUSTED.allowed, UNTRUSTED.accepts)
        if not (isinstance(state, dict) and state.keys() == _ENTRIES and state["counters"].keys() == set(_COUNTERS)):
            raise ValueError("The exact state of the team is damaged, or of another version of this package.")
        if state["n_envs"] != loop.num_envs:
            raise ValueError(
                f"The exact state is of {state['n_envs']} copies of the environment, which now has {loop.num_envs}: give as"
                " many."
            )
        self._pending, self._pending_agents = state, {agent: saved.plain_part(name) for agent, name in names.items()}
        for name, value in state["counters"].items():
            setattr(self._team, name, value)

    @property
    def log_state(self) -> dict[str, Any] | None:
        """How far the logs were, until the team begins to learn; None without a state."""
        return None if self._pending is None else self._pending["log"]

    @property
    def monitor_state(self) -> dict[str, Any] | None:
        """How far the monitor files were, until the team begins to learn; None without a state."""
        return None if self._pending is None else self._pending["monitor"]

    def check_learn(self, reset_num_timesteps: bool) -> None:
        """
        Check that a training that is to go on exactly does not begin anew.

        :param reset_num_timesteps: As ``learn()`` was given it
        :raises ValueError: If it does
        """
        if self._pending is not None and reset_num_timesteps:
            raise ValueError(
                "This team was loaded with exact=True, to go on where it was saved: call learn(remaining steps,"
                " reset_num_timesteps=False). To begin anew load it without exact=True."
            )

    def begin(self, loop: JointLoop, callback: BaseCallback, rngs: RngSwitch) -> bool:
        """
        Put back what a training begins with.

        :param loop: The team's loop
        :param callback: The team's callback
        :param rngs: Lends the global random number generators
        :return: Whether there was a state to go on from
        """
        self._callback, self._needs_reset = callback, None
        state = self._pending
        if state is None:
            return False
        if "seed" in state["env"]:
            loop.env.seed(state["env"]["seed"])
            loop.reset()
        else:
            loop.team_env.set_exact_state(state["env"])
        restore_wrappers(loop.env, state["wrappers"])
        loop.continue_from(*state["last"])
        if state["in_rollout"]:
            # The rest of the agents' states is put back where the rollout begins. Without observations SB3 would reset
            for agent, model in self._models.items():
                model._last_obs = state["last"][0][agent]
        else:
            self._write(state, rngs.put_aside())
        return True

    def _write(self, state: dict[str, Any], rngs_put_aside: AbstractContextManager[None]) -> None:
        """Put back what the agents go on from, and all random numbers."""
        with rngs_put_aside:
            for agent, model in self._models.items():
                write_agent_state(model, self._rngs[agent], self._pending_agents[agent])
            self._rng.set(state["rng"])

    def at_first_rollout(self, loop: JointLoop, log: TeamLog) -> None:
        """
        Put back the rest, where all agents begin their first rollout.

        :param loop: The team's loop
        :param log: The team's log
        """
        state, agents = self._pending, self._pending_agents
        if state is None:
            return
        if state["in_rollout"]:
            self._write(state, loop.put_rngs_aside())
            loop.restore_groups(agents)
        self._pending, self._pending_agents = None, {}
        if state["log"] is not None:
            log.put_back(state["log"])
        if not state["in_rollout"]:
            # Another training, which may have other callbacks
            if state["callbacks"] is not None and have_classes(self._callback, state["callbacks"]):
                restore_callbacks(self._callback, state["callbacks"], "the team")
            return
        restore_callbacks(self._callback, state["callbacks"], "the team")
        for agent, callback in loop.callbacks.items():
            restore_callbacks(callback, state["agent_callbacks"].get(agent, []), repr(agent))


def _begin_episodes(model: BaseAlgorithm) -> None:
    """Give a model the first observations of new episodes, as SB3 does when it begins to learn."""
    assert model.env is not None
    model._last_obs = model.env.reset()  # type: ignore[assignment]
    model._last_episode_starts = np.ones((model.env.num_envs,), dtype=bool)
    if model._vec_normalize_env is not None:
        model._last_original_obs = model._vec_normalize_env.get_original_obs()
