"""The environment of a team in which some agents are partners: they act within it and do not learn."""

from collections.abc import Iterable, Mapping
from typing import Any, TypeAlias

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from sb3_belief.common.action_encoding import RowEncoder
from sb3_belief.common.safe_files.trust import Trust
from sb3_belief.team.fixed_partners.partners import CallersRng, PartnerLike
from sb3_belief.team.partners.acting import CopiesPartner, Seat
from sb3_belief.team.partners.pool import PartnerPool, PoolDraws
from sb3_belief.vec_env.team_vec_env import TeamObs, TeamStep, TeamVecEnv
from sb3_belief.vec_env.team_wrapper import TeamVecEnvWrapper

# Partners by agent: what ``AgentEnv`` takes as a partner, or a pool
Partners: TypeAlias = Mapping[str, PartnerLike | PartnerPool]

# Entries of an info that have one row for each agent
_BY_AGENT = ("agent_rewards", "active", "life_end", "truncated")
# Entries {agent: ...} of which the partners' part is left out
_OF_AGENTS = ("terminal_observation", "terminal_action_masks", "agent_infos")
_OWN_ATTRIBUTES = frozenset(("action_masks", "possible_agents", "scripted_action_spaces"))


class PartnersVecEnv(TeamVecEnvWrapper):
    """
    A ``TeamVecEnv`` around another one, in which partners act for some of its agents.

    ``possible_agents`` are the others, who learn. To them partners are what an environment's scripted others are: they follow
    the learners in the order of the others, in the order of the environment's agents and before its own scripted others. The
    team's reward is the mean of the learners' own.

    A partner acts for all copies in one pass for each step, and in a pool each member that is present makes one pass for its
    copies. It is what it is in an ``AgentEnv``, with these differences: an object with ``predict`` is given batches, and a
    function may act for all copies at once (see ``batched``). Each partner draws from random number generators of its own,
    seeded by ``seed(s)`` as those in an ``AgentEnv`` that is reset with this seed are. In a pool of which each copy draws by
    itself, copy i draws as its seed s + i says.

    ``info["partner"]`` of a step says who has acted: the member's name of each pool, joined by "+" in the order of
    the agents, followed by what the environment itself says. ``get_attr("partner")`` says who will act. Nothing of it is
    in the infos of an agent. An episode in which a partner was replaced, as by a rollout's begin, counts for the last one.

    :param venv: The environment; it is closed with this one
    :param partners: A partner, or a ``PartnerPool`` of them, by agent; at least one agent is left to learn. The same pool for
        several agents is drawn once for all of them
    :param deterministic: Whether partners with a ``predict`` take their most likely actions; False samples, as in training
    :param evaluation: Whether pools are those of evaluations (``PartnerPool.evaluation``) instead of those of training
    :param trust_pickle: As for ``AgentEnv``
    :param allow_packages: As for ``AgentEnv``
    :raises TypeError: If ``venv``, ``partners`` or a partner is of an unsuitable type
    :raises ValueError: For unknown agents, if none is left to learn, or if a partner does not fit
    """

    def __init__(
        self,
        venv: TeamVecEnv,
        partners: Partners,
        deterministic: bool = False,
        evaluation: bool = False,
        trust_pickle: bool = False,
        allow_packages: Iterable[str] = (),
    ):
        if not isinstance(venv, TeamVecEnv):
            raise TypeError(
                f"Partners act in a TeamVecEnv itself (see make_team_env), not in a {type(venv).__name__}: put wrappers around"
                " the PartnersVecEnv."
            )
        given = _checked(partners, venv.possible_agents)
        observed: Any = venv.observation_space
        actions: Any = venv.action_space
        learners = [agent for agent in venv.possible_agents if agent not in given]
        partner_spaces: dict[str, spaces.Space] = {agent: actions[agent] for agent in given}
        super().__init__(
            venv,
            {agent: observed[agent] for agent in learners},
            scripted_action_spaces={**partner_spaces, **venv.scripted_action_spaces},
        )
        self._callers_rng = CallersRng(0)
        # Who is in no pool is one of his own, and stays for ever
        self._pools = {
            agent: partner if isinstance(partner, PartnerPool) else PartnerPool({agent: partner}, redraw_every=None)
            for agent, partner in given.items()
        }
        # By the pool's identity: one that several agents share is drawn once for all of them
        self._draws: dict[int, PoolDraws] = {}
        self._seats: list[tuple[Seat, PoolDraws]] = []
        trust = Trust.of(trust_pickle, allow_packages)
        self._named: list[PoolDraws] = []
        for agent, pool in self._pools.items():
            if id(pool) not in self._draws:
                drawn = pool.evaluation() if evaluation else pool.training()
                self._draws[id(pool)] = PoolDraws(drawn, self.num_envs, stream=len(self._named))
                if pool is given[agent]:
                    self._named.append(self._draws[id(pool)])
            draws = self._draws[id(pool)]
            # Of all members, so that one who does not fit is refused now, and not when it is first evaluated
            fitting = {
                name: CopiesPartner(
                    agent,
                    _member(pool, name, agent, self._pools),
                    observed[agent],
                    actions[agent],
                    deterministic,
                    trust=trust,
                )
                for name in pool.names
            }
            acting = [fitting[name] for name in draws.names]
            index = venv.possible_agents.index(agent)
            self._seats.append((Seat(agent, index, actions[agent], acting, self.num_envs), draws))
        self._encoders = {name: RowEncoder(name, space) for name, space in partner_spaces.items()}
        self._learner_rows, self._columns = _visible_places(venv, learners, list(partner_spaces))

    # The agents' steps

    def _reset_joint(self) -> TeamObs:
        if self._seeds[0] is not None:
            for draws in self._draws.values():
                draws.restart([int(seed) for seed in self._seeds])  # type: ignore[arg-type]
        else:
            # Episodes that are cut off by a reset are over, too
            self._end_episodes(np.flatnonzero(self._lengths))
        obs = super()._reset_joint()
        for seat, _ in self._seats:
            seat.reset(obs[seat.agent], self._seeds[0])
        return {agent: obs[agent] for agent in self.possible_agents}

    def _step_joint(self, actions: TeamObs) -> TeamStep:
        by_partners = self._partners_actions()
        obs, _, dones, infos = super()._step_joint({**actions, **by_partners})
        encoded = np.concatenate([encode(by_partners[name]) for name, encode in self._encoders.items()], axis=1)
        ended = self._own_ends(infos) | dones[:, None]
        names = self.partner_names if self._named else None
        rewards = self._tell_learners(infos, encoded, names)
        for seat, _ in self._seats:
            seat.observe(obs[seat.agent], ended[:, self.venv.possible_agents.index(seat.agent)])
        if dones.any():
            self._end_episodes(np.flatnonzero(dones))
        return {agent: obs[agent] for agent in self.possible_agents}, rewards, dones, infos

    def _partners_actions(self) -> TeamObs:
        masks = self.venv.action_masks() or {}
        # SB3 models draw from the global generators, so each partner gets its own state of them while it acts
        self._callers_rng.suspend()
        try:
            return {seat.agent: seat.act(draws.present, masks.get(seat.agent)) for seat, draws in self._seats}
        finally:
            self._callers_rng.resume()

    def _own_ends(self, infos: list[dict[str, Any]]) -> np.ndarray:
        """Return where each agent's own return has ended or been cut off, bool ``[n_envs, n]``."""
        return np.array([info["life_end"] for info in infos]) | np.array([info["truncated"] for info in infos])

    def _tell_learners(self, infos: list[dict[str, Any]], encoded: np.ndarray, names: list[str] | None) -> np.ndarray:
        """Make the infos of the environment's agents those of the learners, and return the learners' mean rewards."""
        rows = self._learner_rows
        own = {key: np.array([info[key] for info in infos])[:, rows] for key in _BY_AGENT}
        visible = np.array([info["visible"] for info in infos])[:, rows[:, None], self._columns]
        for i, info in enumerate(infos):
            for key in _BY_AGENT:
                info[key] = own[key][i]
            info["visible"] = visible[i]
            scripted = encoded[i]
            info["scripted_actions"] = (
                np.concatenate([scripted, info["scripted_actions"]]) if "scripted_actions" in info else scripted
            )
            for key in _OF_AGENTS:
                if key in info:
                    info[key] = {agent: info[key][agent] for agent in self.possible_agents if agent in info[key]}
            if names is not None:
                info["partner"] = "+".join([names[i], str(info["partner"])] if "partner" in info else [names[i]])
        return own["agent_rewards"].mean(axis=1, dtype=np.float32)

    # Who is there

    @property
    def partner_names(self) -> list[str]:
        """The present members of the pools, one text for each copy."""
        return ["+".join(draws.names[draws.present[i]] for draws in self._named) for i in range(self.num_envs)]

    def begin_rollout(self) -> None:
        """Draw again from the pools whose partners stay for some rollouts, where it is time."""
        super().begin_rollout()
        for draws in self._draws.values():
            draws.begin_rollout()

    def _end_episodes(self, copies: np.ndarray) -> None:
        for draws in self._draws.values():
            draws.end_episodes(copies.tolist())

    def has_attr(self, attr_name: str) -> bool:
        return attr_name in _OWN_ATTRIBUTES or (attr_name == "partner" and bool(self._named)) or super().has_attr(attr_name)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        if attr_name in _OWN_ATTRIBUTES:
            return TeamVecEnv.get_attr(self, attr_name, indices)
        if attr_name != "partner" or not self._named:
            return super().get_attr(attr_name, indices)
        names = [self.partner_names[i] for i in self._get_indices(indices)]
        try:
            inside = super().get_attr(attr_name, indices)
        except AttributeError:
            return names
        return [f"{name}+{other}" for name, other in zip(names, inside, strict=True)]

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        if method_name == "action_masks":
            return TeamVecEnv.env_method(self, method_name, indices=indices)
        return super().env_method(method_name, *method_args, indices=indices, **method_kwargs)

    def _copies_state(self) -> dict[str, Any]:
        # Of the partners their random numbers, recurrent states and draws; what a user's own function remembers is not in it
        return {
            "env": super()._copies_state(),
            "partners": {seat.agent: seat.get_state() for seat, _ in self._seats},
            "draws": [draws.get_state() for draws in self._draws.values()],
        }

    def _set_copies_state(self, state: dict[str, Any]) -> None:
        agents = [seat.agent for seat, _ in self._seats]
        if list(state["partners"]) != agents or len(state["draws"]) != len(self._draws):
            raise ValueError(f"The saved state has partners for {list(state['partners'])}, here they are for {agents}.")
        for draws, saved in zip(self._draws.values(), state["draws"], strict=True):
            draws.set_state(saved)
        super()._set_copies_state(state["env"])
        for seat, _ in self._seats:
            seat.set_state(state["partners"][seat.agent])


def with_partners(env: VecEnv, partners: Partners | None, trust: Trust | None = None) -> VecEnv:
    """
    Put the partners of a team into its environment.

    :param env: The environment
    :param partners: As for :class:`PartnersVecEnv`; None for none
    :param trust: Whom the files of partners may name
    :return: The environment in which the others learn
    """
    if partners is None:
        return env
    trust = trust or Trust.of(False, ())
    return PartnersVecEnv(
        env,  # type: ignore[arg-type]
        partners,
        trust_pickle=trust.trust_pickle,
        allow_packages=trust.allow_packages,
    )


def _checked(partners: Any, agents: list[str]) -> dict[str, Any]:
    """Return the partners in the order of the agents."""
    if not isinstance(partners, Mapping):
        raise TypeError(f"partners must be a dict {{agent: partner or PartnerPool}}, not {type(partners).__name__}.")
    given = {str(agent): partner for agent, partner in partners.items()}
    if not given:
        raise ValueError(f"partners is empty: name at least one agent that a partner acts for, of {agents}.")
    unknown = [agent for agent in given if agent not in agents]
    if unknown:
        raise ValueError(f"partners has entries for unknown agents {unknown}; the environment has {agents}.")
    if len(given) == len(agents):
        raise ValueError(f"Every agent of {agents} has a partner to act for it, so none is left to learn: leave one out.")
    return {agent: given[agent] for agent in agents if agent in given}


def _member(pool: PartnerPool, name: str, agent: str, pools: Mapping[str, PartnerPool]) -> PartnerLike:
    """Return the member's partner for an agent."""
    member = pool.members[name]
    if not isinstance(member, Mapping):
        return member
    seats = [each for each, other in pools.items() if other is pool]
    by_agent = {str(each): partner for each, partner in member.items()}
    if by_agent.keys() != set(seats):
        raise ValueError(f"The member {name!r} of a pool has partners for {list(by_agent)}, but the pool acts for {seats}.")
    return by_agent[agent]


def _visible_places(env: TeamVecEnv, learners: list[str], partners: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """
    Return where in ``info["visible"]`` of the environment the learners' flags are.

    :return: The rows of the learners, ``[n_learners]``, and the columns of their others, ``[n_learners, n_others]``
    """
    agents, scripted = env.possible_agents, list(env.scripted_action_spaces)
    rows, columns = [agents.index(agent) for agent in learners], []
    for agent in learners:
        before = [each for each in agents if each != agent] + scripted
        columns.append([before.index(each) for each in [*learners, *partners, *scripted] if each != agent])
    return np.array(rows), np.array(columns, dtype=int).reshape(len(rows), -1)
