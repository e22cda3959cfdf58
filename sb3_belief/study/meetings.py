"""Trained teams that meet others: who acts where, what the agents observe meanwhile, and how well they do and predict."""

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.vec_env import VecEnvWrapper

from sb3_belief.belief_ppo.policies import BeliefPolicyMixin
from sb3_belief.common.rng import RngState, RngSwitch
from sb3_belief.team import Team, TeamVecEnv, observing
from sb3_belief.team.agent_models import env_seed
from sb3_belief.team.observing import kept_memories
from sb3_belief.team.recurrent import PartnerRecurrentPPO
from sb3_belief.vec_env.agent_vec_env import TransitionSplitter
from sb3_belief.vec_env.observation_forms import map_parts
from sb3_belief.vec_env.observe_last import MEMORY_START
from sb3_belief.zoo.errors import RunFailed
from sb3_belief.zoo.evaluate import Outcome, evaluate

# Joint steps in which none of the observing agents was in play, after which it is given up
_MOST_IDLE = 10_000
# Observations whose predictions are made at a time
_ROWS = 4096


@dataclass(frozen=True)
class Play:
    """
    How meetings are played.

    :param episodes: Episodes of each evaluation
    :param n_envs: Copies of the environment that they are played in
    :param deterministic: Whether all agents act greedily. Otherwise they sample their actions
    :param seed: Seed, from which those of all episodes follow
    :param repetitions: How often each is repeated, with other episodes
    """

    episodes: int = 20
    n_envs: int = 8
    deterministic: bool = True
    seed: int = 0
    repetitions: int = 5

    def episodes_seed(self, repetition: int) -> int:
        """
        Return the seed of the episodes that are evaluated, which are the same whoever is there and whatever was observed.

        :param repetition: Number of the repetition
        """
        return env_seed(self.seed, purpose=5, step=repetition)

    def observed_seed(self, repetition: int) -> int:
        """
        Return the seed of the episodes that agents observe.

        :param repetition: Number of the repetition
        """
        return env_seed(self.seed, purpose=4, step=repetition)


class Among:
    """
    One agent of a team among the agents of another, which acts like a ``Team``.

    :param team: The team of the one
    :param agent: Its name
    :param others: The team of the others
    """

    def __init__(self, team: Team, agent: str, others: Team):
        self._team, self._agent, self._others = team, agent, others
        self._rest = [each for each in team.possible_agents if each != agent]

    @property
    def takes_masks(self) -> bool:
        """Whether a model takes action masks."""
        return self._team.takes_masks or self._others.takes_masks

    def predict(
        self,
        observation: Any,
        state: tuple[Any, Any] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
        action_masks: Any = None,
    ) -> tuple[dict[str, np.ndarray], tuple[Any, Any]]:
        """
        Predict as ``Team.predict`` does.

        :param observation: Observations of all agents, as the environment returns them
        :param state: As returned by the last call, None at first
        :param episode_start: As for ``Team.predict``
        :param deterministic: As for ``Team.predict``
        :param action_masks: As for ``Team.predict``
        :return: Actions of all agents, and the recurrent states of both teams
        """
        own, theirs = state or (None, None)
        acted, own = self._team.predict(observation.of([self._agent]), own, episode_start, deterministic, action_masks)
        rest, theirs = self._others.predict(observation.of(self._rest), theirs, episode_start, deterministic, action_masks)
        return {**acted, **rest}, (own, theirs)


class Measured(NamedTuple):
    """
    What was found with memories as they were.

    :param outcome: The episodes
    :param accuracy: Share of the others' visible discrete actions that the agents expected most; None if nothing is predicted
    :param base_rate: The same of always naming each other's most frequent action in these episodes
    """

    outcome: Outcome
    accuracy: float | None
    base_rate: float | None

    def columns(self) -> dict[str, Any]:
        """Return the columns of a table that say so."""
        return {
            "episodes": len(self.outcome.returns),
            "return": float(self.outcome.returns.mean()),
            "success": self.outcome.success_rate,
        }


@dataclass
class Meeting:
    """
    Agents of a team that meet others.

    :param team: The team
    :param agents: Those of its agents that are measured, and observe
    :param model: What acts in the environments: the team, or one of its agents :class:`Among` others
    :param env: Where episodes are evaluated, in several copies
    :param observed_env: Where the agents observe, in one copy
    :param told: What the environment calls those whom they met; filled in while it is played
    """

    team: Team
    agents: Sequence[str]
    model: Any
    env: TeamVecEnv
    observed_env: TeamVecEnv
    told: set[str] = field(default_factory=set)

    @property
    def observers(self) -> list[str]:
        """Those of the agents that have a belief which a history feeds."""
        return [agent for agent in self.agents if has_history(self.team.agents[agent].policy)]

    @property
    def rememberers(self) -> list[str]:
        """Those of the agents whose recurrent state lasts over episodes."""
        return [agent for agent in self.agents if isinstance(self.team.agents[agent], PartnerRecurrentPPO)]

    @property
    def can_adapt(self) -> bool:
        """Whether one of the agents remembers anything of earlier episodes."""
        return bool(self.observers or self.rememberers)

    def measure(self, play: Play, repetition: int, memory: Mapping[str, Any] | None = None) -> Measured:
        """
        Evaluate with memories as they are, and without observing.

        :param play: How
        :param repetition: Number of the repetition
        :param memory: Recurrent states of one copy by agent, with which all copies begin; for agents whose state lasts over
            episodes. None for empty ones
        :return: What was found
        """
        seed, memory = play.episodes_seed(repetition), memory or {}
        witness = _Witness(self.env, self.team, self.agents, self.told, memory)
        policies: list[Any] = [self.team.agents[agent].policy for agent in self.observers]
        self.env.seed(seed)
        with kept_memories(policies):
            for policy in policies:
                # What is evaluated are other episodes than that which has been observed
                policy.end_episodes()
            with RngSwitch(RngState(seed)):
                outcome = evaluate(
                    _Remembering(self.model, memory, self.env.num_envs), witness, play.episodes, play.deterministic
                )
            return Measured(outcome, *witness.accuracy())

    def adapt(self, checkpoints: Sequence[int], play: Play, repetition: int) -> dict[int, Measured]:
        """
        Measure after each of several numbers of steps that the agents have observed, from their saved histories on.

        Afterwards the histories are as before. Recurrent states that last over episodes are empty at first, since none is
        saved with a model. Agents that have neither play as many steps all the same.

        :param checkpoints: The numbers, ascending
        :param play: How
        :param repetition: Number of the repetition
        :return: What was found after each
        :raises RunFailed: If an agent that is to observe is never in play
        """
        observers, seed = self.observers, play.observed_seed(repetition)
        self.observed_env.seed(seed)
        watching: AbstractContextManager[Any] = nullcontext(self.observed_env)
        if observers:
            watching = observing(self.team, self.observed_env, most_steps=0, agents=observers)
        found = {}
        with watching as env:
            player = _Player(self.model, env, play.deterministic, seed, self.told)
            for steps in checkpoints:
                player.go_on(steps)
                found[steps] = self.measure(play, repetition, player.memory(self.rememberers))
        return found


def has_history(policy: Any) -> bool:
    """
    Tell whether a policy has a belief that a history feeds.

    :param policy: Of an agent
    """
    return isinstance(policy, BeliefPolicyMixin) and policy.history is not None


class _Remembering:
    """Acts like a model whose agents remember something when the episodes begin."""

    def __init__(self, model: Any, memory: Mapping[str, Any], n_envs: int):
        self._model = model
        # [n_layers, 1, n_hidden] each
        copies = {agent: tuple(np.repeat(part, n_envs, axis=1) for part in state) for agent, state in memory.items()}
        own = copies or None
        self._first: Any = (own, None) if own and isinstance(model, Among) else own

    @property
    def takes_masks(self) -> bool:
        return self._model.takes_masks

    def predict(self, observation: Any, state: Any = None, *args: Any, **kwargs: Any) -> Any:
        return self._model.predict(observation, self._first if state is None else state, *args, **kwargs)


class _Player:
    """Plays on in one copy of an environment in which agents observe."""

    def __init__(self, model: Any, env: Any, deterministic: bool, seed: int, told: set[str]):
        self._model, self._env, self._deterministic, self._told = model, env, deterministic, told
        self._rng = RngState(seed)
        self._obs: Any = None
        self._state: Any = None
        self._starts = np.ones(env.num_envs, dtype=bool)
        self._played = 0

    def _steps(self) -> int:
        """Return how many steps each observer has observed at least; those played if nobody observes."""
        observed: Mapping[str, int] | None = getattr(self._env, "steps", None)
        return min(observed.values()) if observed is not None else self._played

    def memory(self, agents: Sequence[str]) -> dict[str, Any]:
        """
        Return the recurrent states of some agents, of those that have one by now.

        :param agents: Their names
        """
        own = self._state[0] if isinstance(self._model, Among) and self._state else self._state
        return {agent: own[agent] for agent in agents if own and own[agent] is not None}

    def go_on(self, steps: int) -> None:
        """
        Play until each observer has observed so many steps in all, exactly.

        :param steps: The number
        """
        self._env.most_steps = steps
        idle = 0
        with RngSwitch(self._rng):
            while (before := self._steps()) < steps:
                self._step()
                idle = 0 if self._steps() > before else idle + 1
                if idle > _MOST_IDLE:
                    raise RunFailed(
                        f"For {_MOST_IDLE:,} joint steps an agent that is to observe was not in play: {dict(self._env.steps)}"
                        f" of {steps} steps are observed. Fewer steps, or another agent, may do."
                    )

    def _step(self) -> None:
        if self._obs is None:
            self._obs = self._env.reset()
        masks = self._env.unwrapped.action_masks() if self._model.takes_masks else None
        actions, self._state = self._model.predict(
            self._obs, self._state, self._starts, self._deterministic, action_masks=masks
        )
        self._obs, _, self._starts, infos = self._env.step(actions)
        self._told.update(str(info["partner"]) for info in infos if "partner" in info)
        self._played += 1


class _Witness(VecEnvWrapper):
    """Keeps what agents that predict others see of an evaluation, whose memories stay as they are meanwhile."""

    def __init__(self, env: TeamVecEnv, team: Team, agents: Collection[str], told: set[str], rememberers: Collection[str]):
        super().__init__(env)
        self._rememberers = rememberers
        acted: Any = env.action_space
        self._names, self._told = env.possible_agents, told
        actions = {agent: acted[agent] for agent in env.possible_agents}
        self._splitter = TransitionSplitter(env.possible_agents, actions, env.scripted_action_spaces)
        self._observed: Callable[[str, Any], Any] = team.observed_by
        policies: dict[str, Any] = {agent: team.agents[agent].policy for agent in agents}
        self._policies = {agent: policy for agent, policy in policies.items() if _predicts(policy)}
        # Observations and the others' actions at the steps in which the agent was in play
        self._seen: dict[str, list[tuple[Any, np.ndarray]]] = {agent: [] for agent in self._policies}
        self._obs: Any = None
        self._actions: Any = None

    def reset(self) -> Any:
        self._obs = self.venv.reset()
        for agent in self._rememberers:
            # To these agents the partner is not a new one
            self._obs[agent][MEMORY_START][:] = 0
        return self._obs

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions
        self.venv.step_async(actions)

    def step_wait(self) -> Any:
        step: Any = self.venv.step_wait()
        if self._policies:
            transitions = dict(zip(self._names, self._splitter.transitions(self._actions, step), strict=True))
            for agent, seen in self._seen.items():
                rows = transitions[agent].active
                seen.append(
                    (map_parts(lambda part, rows=rows: part[rows], self._obs[agent]), transitions[agent].others_actions[rows])
                )
        self._obs = step[0]
        self._told.update(str(info["partner"]) for info in step[3] if "partner" in info)
        return step

    def accuracy(self) -> tuple[float | None, float | None]:
        """Return accuracy and base rate of all agents together; None where there is no prediction of a discrete action."""
        right = most_frequent = total = 0
        for agent, policy in self._policies.items():
            observations, acted = zip(*self._seen[agent], strict=True)
            observed = self._observed(agent, map_parts(_joined, *observations))
            actions = np.concatenate(acted)
            expected = np.zeros_like(actions)
            for start in range(0, len(actions), _ROWS):
                rows = slice(start, start + _ROWS)
                expected[rows] = _expected(policy, map_parts(lambda part, rows=rows: part[rows], observed))
            for _, start, width in policy.layout.blocks:
                # A one-hot code is zero where the action was not visible
                taken = actions[:, start : start + width]
                visible = taken.any(axis=1)
                if visible.any():
                    named = expected[visible, start : start + width].argmax(axis=1)
                    chosen = taken[visible].argmax(axis=1)
                    right += int((named == chosen).sum())
                    most_frequent += int(np.bincount(chosen).max())
                    total += len(chosen)
        return (right / total, most_frequent / total) if total else (None, None)


def _predicts(policy: Any) -> bool:
    return isinstance(policy, BeliefPolicyMixin) and policy.has_belief and bool(policy.options.variant.predicts)  # type: ignore[union-attr]


def _joined(*parts: np.ndarray) -> np.ndarray:
    return np.concatenate(parts)


def _expected(policy: Any, obs: Any) -> np.ndarray:
    predicted = policy.predict_others(obs).actions
    return np.concatenate([predicted[name].reshape(len(predicted[name]), -1) for name in policy.others_action_spaces], axis=1)
