"""SMAX as compiled JAX functions over all copies of a battle."""

import io
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, NamedTuple

# The settings of SMAX that a user may change. The map determines the others, or they would change the meaning of observations
# or actions
OPTIONS = (
    "enemy_shoots",
    "attack_mode",
    "see_enemy_actions",
    "walls_cause_death",
    "won_battle_bonus",
    "max_steps",
    "world_steps_per_env_step",
    "time_per_step",
    "map_width",
    "map_height",
)
ATTACK_MODES = ("closest", "random")


@dataclass(frozen=True)
class BattleConfig:
    """
    The rules of a battle.

    :param map_name: One of ``map_names()``
    :param observe_last_actions: Whether observations contain the allies' last actions
    :param options: (name, value) of the settings of SMAX that are changed, see ``OPTIONS``. A sorted tuple, so that equal
        rules have equal hashes
    :raises ValueError: For an unknown map or option
    """

    map_name: str
    observe_last_actions: bool = False
    options: tuple[tuple[str, Any], ...] = ()

    @classmethod
    def of(cls, map_name: str, observe_last_actions: bool, options: Mapping[str, Any]) -> "BattleConfig":
        """
        Return the rules for arguments of an environment.

        :param map_name: One of ``map_names()``
        :param observe_last_actions: Whether observations contain the allies' last actions
        :param options: Settings of SMAX to change
        :return: The rules
        :raises ValueError: For an unknown map or option
        """
        return cls(map_name, observe_last_actions, tuple(sorted(options.items())))

    def __post_init__(self) -> None:
        known = map_names()
        if self.map_name not in known:
            raise ValueError(f"Unknown SMAX map {self.map_name!r}; there are {', '.join(known)}.")
        unknown = [name for name, _ in self.options if name not in OPTIONS]
        if unknown:
            raise ValueError(
                f"Unknown argument {', '.join(map(repr, unknown))} for smax/{self.map_name}; allowed are"
                f" 'observe_last_actions', 'render_mode' and, of SMAX, {', '.join(map(repr, OPTIONS))}."
            )
        attack_mode = dict(self.options).get("attack_mode", ATTACK_MODES[0])
        # SMAX itself would treat any other value as "closest"
        if attack_mode not in ATTACK_MODES:
            raise ValueError(f"attack_mode={attack_mode!r} is not one of {', '.join(map(repr, ATTACK_MODES))}.")


class BattleView(NamedTuple):
    """
    Observable part of the state of n battles with A agents.

    :param observations: float32 [A, n, width]
    :param masks: Which actions are possible, bool [A, n, k]
    :param visible: Which of the A-1 others each agent sees, bool [n, A, A-1]
    :param alive: Which agents are alive, bool [n, A]
    """

    observations: Any
    masks: Any
    visible: Any
    alive: Any


class BattleOutcome(NamedTuple):
    """
    Rewards and ends of one step of n battles.

    :param rewards: Team rewards, float32 [n]
    :param ended: Whether the battle has ended, bool [n]
    :param won: Whether all enemies are dead and an ally is alive, bool [n]
    :param cut: Whether the battle ended by the step limit, bool [n]
    """

    rewards: Any
    ended: Any
    won: Any
    cut: Any


class DrawingData(NamedTuple):
    """
    Data that a picture of a battle needs besides the units.

    :param map_size: Width and height of the map
    :param radii: Radius of each unit type
    :param full_health: Full health of each unit type
    :param letters: Letter for each unit type
    """

    map_size: tuple[float, float]
    radii: Any
    full_health: Any
    letters: list[str]


class BattleProgram:
    """
    The compiled functions of a battle.

    ``keys`` is uint32 [n, 2], the state of one random generator for each copy. ``states`` is SMAX's own.

    - ``begin(keys)`` returns keys, states and a ``BattleView`` of new battles.
    - ``advance(keys, states, actions int32 [n, A])`` performs one step without resets and returns keys, states, a
      ``BattleView`` and a ``BattleOutcome``.
    - ``choose(ended bool [n], new, old)`` returns the new keys and states of battles that have ended and the old ones of the
      others.
    - ``world_states(states)`` returns SMAX's world state of each copy, float32 [n, ``state_width``]: all units.

    :param config: The rules
    """

    def __init__(self, config: BattleConfig):
        import jax
        import jax.numpy as jnp
        import numpy as np

        smax_class, scenarios = _import_smax()
        env = smax_class(scenario=scenarios[config.map_name], **dict(config.options))
        self.agents: list[str] = list(env.agents)
        self.n_actions = int(env.num_ally_actions)
        self.stop = int(env.num_movement_actions) - 1
        self.width = int(env.obs_size)
        self.drawing = DrawingData(
            (env.map_width, env.map_height),
            np.asarray(env.unit_type_radiuses),
            np.asarray(env.unit_type_health),
            list(env.unit_type_shorthands),
        )
        n_agents, n_features = len(self.agents), len(env.unit_features)
        # Indices of the last action within the features of one ally
        last_action = [i for i, name in enumerate(env.unit_features) if name.startswith("last_")]
        others = np.array([[j for j in range(n_agents) if j != i] for i in range(n_agents)], dtype=int).reshape(n_agents, -1)

        def strong(tree: Any) -> Any:
            # SMAX's reset and step return different weak types, for each of which JAX would compile everything once
            return jax.tree.map(lambda leaf: jax.lax.convert_element_type(leaf, leaf.dtype), tree)

        def view(state: Any, observations: dict[str, Any]) -> BattleView:
            units = state.state
            obs = jnp.stack([observations[agent] for agent in self.agents])
            if not config.observe_last_actions:
                # The allies' features come first in an observation
                blocks = obs[:, : (n_agents - 1) * n_features].reshape(n_agents, n_agents - 1, n_features)
                blocks = blocks.at[:, :, jnp.array(last_action)].set(0.0)
                obs = jnp.concatenate([blocks.reshape(n_agents, -1), obs[:, (n_agents - 1) * n_features :]], axis=1)
            possible = env.get_avail_actions(state)
            masks = jnp.stack([possible[agent] for agent in self.agents]).astype(bool)
            positions, alive = units.unit_positions[:n_agents], units.unit_alive[:n_agents]
            distances = jnp.linalg.norm(positions[None, :] - positions[:, None], axis=-1)
            sight = env.unit_type_sight_ranges[units.unit_types[:n_agents]]
            sees = (distances < sight[:, None]) & alive[:, None] & alive[None, :]
            return BattleView(obs, masks, jnp.take_along_axis(sees, jnp.asarray(others), axis=1), alive)

        def begin_one(key: Any) -> tuple[Any, Any, BattleView]:
            key, reset_key = jax.random.split(key)
            observations, state = env.reset(reset_key)
            return key, strong(state), view(state, observations)

        def advance_one(key: Any, state: Any, actions: Any) -> tuple[Any, Any, BattleView, BattleOutcome]:
            key, step_key = jax.random.split(key)
            joint = {agent: actions[i] for i, agent in enumerate(self.agents)}
            # step_env() instead of step(), which would start the next battle at once and lose the last observation
            observations, state, rewards, dones, _ = env.step_env(step_key, state, joint)
            alive = state.state.unit_alive
            allies, enemies = alive[:n_agents].any(), alive[n_agents:].any()
            # SMAX's "done" does not distinguish the step limit from a battle that is over, but with the limit both sides live
            outcome = BattleOutcome(
                rewards[self.agents[0]], dones["__all__"], allies & ~enemies, dones["__all__"] & allies & enemies
            )
            return key, strong(state), view(state, observations), outcome

        # vmap adds the axis of copies: second for arrays by agent, first for all others
        by_agent = BattleView(observations=1, masks=1, visible=0, alive=0)

        def choose(ended: Any, new: Any, old: Any) -> Any:
            return jax.tree.map(lambda n, o: jnp.where(ended.reshape(-1, *[1] * (n.ndim - 1)), n, o), new, old)

        self.begin = jax.jit(jax.vmap(begin_one, out_axes=(0, 0, by_agent)))
        self.advance = jax.jit(jax.vmap(advance_one, out_axes=(0, 0, by_agent, 0)))
        # Starting battles in all copies and choosing afterwards needs only one compiled version of begin
        self.choose = jax.jit(choose)
        # Not part of the view: who has no joint learner never compiles it
        self.world_states = jax.jit(jax.vmap(env.get_world_state))
        self.state_width = int(env.state_size)
        self._jax = jax

    @cached_property
    def _structure(self) -> Any:
        # The tree of SMAX's states with shapes and types, found without running or compiling anything
        keys = self._jax.ShapeDtypeStruct((1, 2), "uint32")
        return self._jax.eval_shape(self.begin, keys)[1]

    def leaves(self, states: Any) -> list[Any]:
        """
        Return the arrays that states consist of.

        :param states: States of SMAX for n copies
        :return: Arrays [n, ...]
        """
        return self._jax.tree.leaves(states)

    def states(self, leaves: list[Any]) -> Any:
        """
        Return states made of arrays.

        :param leaves: Arrays that :meth:`leaves` returned for the same map
        :return: States of SMAX
        :raises ValueError: If they belong to another map
        """
        expected, structure = self._jax.tree.flatten(self._structure)
        required = [(leaf.shape[1:], leaf.dtype) for leaf in expected]
        given = [(leaf.shape[1:], leaf.dtype) for leaf in leaves]
        if required != given:
            raise ValueError("This is not a state of a battle on this map: a state fits the map that it was taken from.")
        return self._jax.tree.unflatten(structure, leaves)


@cache
def battle_program(config: BattleConfig) -> BattleProgram:
    """
    Return the compiled functions for some rules.

    :param config: The rules
    :return: The program. All environments with the same rules share it, so that it is compiled only once
    """
    return BattleProgram(config)


def map_names() -> list[str]:
    """
    Return the maps of SMAX.

    :return: Names of maps, in SMAX's order
    """
    return list(_import_smax()[1])


@contextmanager
def _silence() -> Iterator[None]:
    """Suppress what the import of jaxmarl prints, and undo its reset of sys.stdout and sys.stderr to the original streams."""
    before = sys.stdout, sys.stderr, sys.__stdout__
    sys.stdout = sys.__stdout__ = io.StringIO()  # type: ignore[misc, assignment]
    try:
        yield
    finally:
        sys.stdout, sys.stderr, sys.__stdout__ = before  # type: ignore[misc]


@cache
def _import_smax() -> tuple[Any, dict[str, Any]]:
    """
    Import SMAX.

    :return: The class of battles against scripted enemies, and its maps by name
    """
    with _silence():
        from jaxmarl.environments.smax import HeuristicEnemySMAX
        from jaxmarl.environments.smax.smax_env import MAP_NAME_TO_SCENARIO
    return HeuristicEnemySMAX, MAP_NAME_TO_SCENARIO
