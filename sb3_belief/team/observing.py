"""Agents that observe while they are evaluated: what they see goes into their histories, and no weight changes."""

from abc import abstractmethod
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from sb3_belief.belief_ppo.policies import BeliefPolicyMixin
from sb3_belief.team.arguments import check_agent_keys, check_team_vec_env
from sb3_belief.team.team import Team
from sb3_belief.vec_env.agent_vec_env import TransitionSplitter
from sb3_belief.vec_env.observation_forms import map_parts
from sb3_belief.vec_env.team_vec_env import TeamVecEnv


class _Seen(NamedTuple):
    """
    What an agent observed of a step: its observations when it acted, the others' actions ``[n, W]``, whether each was visible
    ``[n, n_others]``, where it acted, its own actions and rewards, and where its return has ended.
    """

    obs: Any
    others_actions: np.ndarray
    others_visible: np.ndarray
    active: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    dones: np.ndarray


class ObservingVecEnv(VecEnvWrapper):
    """
    Environment that hands agents what they observe of each step, in all copies at once, as long as it is open.

    Made by :func:`observing`. A step is in an agent's history before it acts next, so what it does at step t + 1 may follow
    from what the others did at step t, in this copy or another.

    :param venv: The environment
    :param policies: The policies that have a history, by agent
    :param most_steps: How many steps each agent observes at most; None without a limit
    """

    def __init__(self, venv: VecEnv, policies: Mapping[str, BeliefPolicyMixin], most_steps: int | None):
        super().__init__(venv)
        self._policies = policies
        #: How many steps each agent observes at most, which may be raised as it goes on; None without a limit
        self.most_steps = most_steps
        #: How many steps each agent has observed: those in which it was in play, of all copies together
        self.steps = dict.fromkeys(policies, 0)
        #: Whether steps are observed; set to False to go on without
        self.is_open = True
        # In which copies the return of each agent goes on, so that it waits for its turn where it is not in play
        self._goes_on = {agent: np.zeros(venv.num_envs, dtype=bool) for agent in policies}
        # What each agent observed at its last turn in each copy
        self._at_turn: dict[str, Any] = {}
        self._obs: Any = None
        self._actions: Any = None

    def reset(self) -> Any:
        """
        Reset all copies.

        :return: As of the environment within
        """
        self._obs = self.venv.reset()
        for agent, goes_on in self._goes_on.items():
            # Whatever was under way is over
            self._policies[agent].end_episodes()
            goes_on[:] = False
        return self._obs

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions
        self.venv.step_async(actions)

    def step_wait(self) -> Any:
        """
        Step all copies, and let the agents remember what they observed of it.

        :return: As of the environment within
        :raises RuntimeError: If it was not reset by this one
        """
        if self._obs is None:
            raise RuntimeError("An environment in which agents observe has to be reset before it is stepped.")
        step: Any = self.venv.step_wait()
        if self.is_open:
            for agent, seen in self._seen(step).items():
                self._remember(agent, seen)
        self._obs = step[0]
        return step

    @abstractmethod
    def _seen(self, step: Any) -> dict[str, _Seen]:
        """Return what each agent observed of a step."""

    def _remember(self, agent: str, seen: _Seen) -> None:
        policy, active, goes_on = self._policies[agent], np.flatnonzero(seen.active), self._goes_on[agent]
        if self.most_steps is not None:
            active = active[: self.most_steps - self.steps[agent]]
        rows, obs = active, seen.obs
        if policy.remembers_waiting:
            before = self._at_turn.get(agent, obs)
            obs = self._at_turn[agent] = map_parts(lambda *parts: _of_rows(seen.active, *parts), obs, before)
            if self.most_steps is None or self.steps[agent] < self.most_steps:
                rows = np.union1d(active, np.flatnonzero(goes_on & ~seen.active & seen.others_visible.any(axis=1)))
        if len(rows):
            policy.remember(
                map_parts(lambda part: part[rows], obs),
                seen.others_actions[rows],
                dict(zip(policy.others_action_spaces, seen.others_visible[rows].T, strict=True)),
                own_actions=seen.actions[rows],
                acted=seen.active[rows],
                rewards=seen.rewards[rows],
                copies=rows,
            )
            self.steps[agent] += len(active)
        elif self.most_steps is None or self.steps[agent] < self.most_steps:
            policy.pass_time()
        goes_on |= seen.active
        goes_on &= ~seen.dones
        if seen.dones.any():
            policy.end_episodes(np.flatnonzero(seen.dones))


def _of_rows(chosen: np.ndarray, there: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """Return the chosen rows of one array, and the rest of another."""
    return np.where(chosen.reshape(-1, *[1] * (np.ndim(there) - 1)), there, otherwise)


class _ObservingTeam(ObservingVecEnv):
    def __init__(self, venv: VecEnv, policies: Mapping[str, BeliefPolicyMixin], most_steps: int | None, team: Team):
        super().__init__(venv, policies, most_steps)
        team_env: Any = venv.unwrapped
        acted: Any = venv.action_space
        self._team, self._agents = team, team_env.possible_agents
        actions = {agent: acted[agent] for agent in self._agents}
        self._splitter = TransitionSplitter(self._agents, actions, team_env.scripted_action_spaces)

    def _seen(self, step: Any) -> dict[str, _Seen]:
        transitions = dict(zip(self._agents, self._splitter.transitions(self._actions, step), strict=True))
        seen = {}
        for agent in self._policies:
            own = transitions[agent]
            obs, did = self._team.observed_by(agent, self._obs[agent]), np.asarray(self._actions[agent])
            rewards = self._team.rewarded_by(agent, own.rewards)
            seen[agent] = _Seen(obs, own.others_actions, own.others_visible, own.active, did, rewards, own.dones)
        return seen


class _ObservingLearner(ObservingVecEnv):
    def _seen(self, step: Any) -> dict[str, _Seen]:
        _, rewards, dones, infos = step
        try:
            others_actions = np.stack([info["others_actions"] for info in infos])
            others_visible = np.stack([info["others_visible"] for info in infos])
            active = np.array([info["active"] for info in infos])
        except KeyError as error:
            raise ValueError(
                f"The infos of the environment lack {error.args[0]!r}, so there is nothing to observe: use an AgentEnv."
            ) from None
        seen = _Seen(self._obs, others_actions, others_visible, active, np.asarray(self._actions), rewards, dones)
        return dict.fromkeys(self._policies, seen)


@contextmanager
def observing(
    model: Any, env: VecEnv, most_steps: int | None = None, agents: Collection[str] | None = None
) -> Iterator[ObservingVecEnv]:
    """
    Let agents observe while they act in an environment, as they do when they are deployed::

        with observing(team, env) as watched:
            evaluate_policy(team, watched)

    Each step in which an agent is in play is appended to its history: its observation, and the actions of the others that it
    could see. Nothing else of the environment is read, no weight changes and no random number is drawn. Afterwards every
    history is what it was before.

    :param model: A ``Team``, or a single SB3 model of ours that acts in a vectorised :class:`AgentEnv`
    :param env: The environment in which it is evaluated, with any number of copies, which all fill the same history of an
        agent. For a single model with all wrappers of its observations, such as ``VecNormalize``
    :param most_steps: How many steps each agent observes at most, at least 0: exactly as many, if as many are played. None
        without a limit
    :param agents: Names of a team's agents that observe; None for all
    :return: The environment to evaluate in. Its ``steps`` says how many steps each agent has observed; those of a single
        model have the name of the learner. While its ``is_open`` is set to False, nothing is observed
    :raises TypeError: If ``model`` is neither a team nor a model, or the environment is not one of a team
    :raises ValueError: If no agent has a belief that a history feeds, if the environment has other agents than the team, or
        for a negative ``most_steps``
    """
    if most_steps is not None and (isinstance(most_steps, bool) or not isinstance(most_steps, int) or most_steps < 0):
        raise ValueError(f"most_steps={most_steps!r} must be a number of steps of at least 0, or None for no limit.")
    if isinstance(model, Team):
        team_env: Any = check_team_vec_env(env).unwrapped
        if team_env.possible_agents != model.possible_agents:
            raise ValueError(f"The team has the agents {model.possible_agents}, the environment {team_env.possible_agents}.")
        if agents is not None:
            check_agent_keys("agents", dict.fromkeys(agents), model.possible_agents)
        models = {agent: each for agent, each in model.agents.items() if agents is None or agent in agents}
    elif isinstance(model, BaseAlgorithm):
        if isinstance(env.unwrapped, TeamVecEnv):
            raise TypeError("A single model observes in a vectorised AgentEnv; this is the environment of a team.")
        models = {env.get_attr("agent")[0] if env.has_attr("agent") else "agent": model}
    else:
        raise TypeError(f"A Team or an SB3 model can observe, not a {type(model).__name__}.")
    policies = {agent: each.policy for agent, each in models.items() if isinstance(each.policy, BeliefPolicyMixin)}
    policies = {agent: policy for agent, policy in policies.items() if policy.history is not None}
    if not policies:
        found = ", ".join(f"{agent}: {type(each).__name__}" for agent, each in models.items())
        raise ValueError(
            "Nobody here has a belief that a history feeds, so observing would change nothing: it takes a BeliefPPO with"
            f" belief='adaptive', 'dynamic' or 'context' and others to observe. The models are {found}."
        )
    observed: ObservingVecEnv
    if isinstance(model, Team):
        observed = _ObservingTeam(env, policies, most_steps, model)
    else:
        observed = _ObservingLearner(env, policies, most_steps)
    with kept_memories(policies.values()):
        try:
            yield observed
        finally:
            observed.is_open = False


@contextmanager
def kept_memories(policies: Iterable[BeliefPolicyMixin]) -> Iterator[None]:
    """
    Put back afterwards what policies remember, whatever they have remembered and been told meanwhile. They cannot learn
    meanwhile.

    :param policies: The policies
    """
    states = [(policy, policy.memory_state(), policy.is_kept) for policy in policies]
    try:
        for policy, _, _ in states:
            policy.is_kept = True
        yield
    finally:
        for policy, state, was_kept in states:
            policy.restore_memory_state(state)
            policy.is_kept = was_kept
