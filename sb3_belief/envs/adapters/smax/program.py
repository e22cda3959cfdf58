"""SMAX as compiled functions over all copies of a battle."""

import io
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, NamedTuple

# What a user may choose of SMAX; the rest is given by the map, or would change what an observation or an action is
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

    :param map_name: one of ``map_names()``
    :param observe_last_actions: leave the allies' last actions in the observations
    :param options: (name, value) of what is changed of SMAX, see ``OPTIONS``
    :raises ValueError: for an unknown map or option
    """

    map_name: str
    observe_last_actions: bool = False
    options: tuple[tuple[str, Any], ...] = ()

    @classmethod
    def of(cls, map_name: str, observe_last_actions: bool, options: Mapping[str, Any]) -> "BattleConfig":
        """
        :param map_name: one of ``map_names()``
        :param observe_last_actions: leave the allies' last actions in the observations
        :param options: what is changed of SMAX
        :return: the rules
        :raises ValueError: for an unknown map or option
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
        if attack_mode not in ATTACK_MODES:  # SMAX takes anything else for "closest"
            raise ValueError(f"attack_mode={attack_mode!r} is not one of {', '.join(map(repr, ATTACK_MODES))}.")


class View(NamedTuple):
    """
    What can be seen of battles, as arrays of A agents in n copies.

    :param observations: float32 [A, n, width]
    :param masks: which actions are possible, bool [A, n, k]
    :param visible: whom of the A-1 others each agent sees, bool [n, A, A-1]
    :param alive: bool [n, A]
    """

    observations: Any
    masks: Any
    visible: Any
    alive: Any


class Outcome(NamedTuple):
    """
    How a step went in n copies.

    :param rewards: the team's, float32 [n]
    :param ended: bool [n]
    :param won: all enemies are dead and an ally is alive, bool [n]
    :param cut: ended by the step limit, bool [n]
    """

    rewards: Any
    ended: Any
    won: Any
    cut: Any


class Look(NamedTuple):
    """
    What a picture of a battle needs besides its units.

    :param map_size: width and height
    :param radii: of the unit types
    :param full_health: of the unit types
    :param letters: for the unit types
    """

    map_size: tuple[float, float]
    radii: Any
    full_health: Any
    letters: list[str]


class BattleProgram:
    """
    The compiled functions of a battle. ``keys`` is uint32 [n, 2], one random generator for each copy; ``states`` are SMAX's.

    - ``begin(keys)`` -> keys, states, View: new battles
    - ``advance(keys, states, actions int32 [n, A])`` -> keys, states, View, Outcome: one step, nothing is reset
    - ``choose(ended bool [n], new, old)`` -> what is new where a battle ended, old elsewhere (keys and states)

    :param config: the rules
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
        self.look = Look(
            (env.map_width, env.map_height),
            np.asarray(env.unit_type_radiuses),
            np.asarray(env.unit_type_health),
            list(env.unit_type_shorthands),
        )
        n_agents, n_features = len(self.agents), len(env.unit_features)
        # In an ally's block of features
        last_action = [i for i, name in enumerate(env.unit_features) if name.startswith("last_")]
        others = np.array([[j for j in range(n_agents) if j != i] for i in range(n_agents)], dtype=int).reshape(n_agents, -1)

        def strong(tree: Any) -> Any:
            # SMAX's reset and step return different weak types, for which everything would be compiled a second time
            return jax.tree.map(lambda leaf: jax.lax.convert_element_type(leaf, leaf.dtype), tree)

        def view(state: Any, observations: dict[str, Any]) -> View:
            units = state.state
            obs = jnp.stack([observations[agent] for agent in self.agents])
            if not config.observe_last_actions:
                blocks = obs[:, : (n_agents - 1) * n_features].reshape(n_agents, n_agents - 1, n_features)
                blocks = blocks.at[:, :, jnp.array(last_action)].set(0.0)
                obs = jnp.concatenate([blocks.reshape(n_agents, -1), obs[:, (n_agents - 1) * n_features :]], axis=1)
            possible = env.get_avail_actions(state)
            masks = jnp.stack([possible[agent] for agent in self.agents]).astype(bool)
            positions, alive = units.unit_positions[:n_agents], units.unit_alive[:n_agents]
            distances = jnp.linalg.norm(positions[None, :] - positions[:, None], axis=-1)
            sight = env.unit_type_sight_ranges[units.unit_types[:n_agents]]
            sees = (distances < sight[:, None]) & alive[:, None] & alive[None, :]
            return View(obs, masks, jnp.take_along_axis(sees, jnp.asarray(others), axis=1), alive)

        def begin_one(key: Any) -> tuple[Any, Any, View]:
            key, reset_key = jax.random.split(key)
            observations, state = env.reset(reset_key)
            return key, strong(state), view(state, observations)

        def advance_one(key: Any, state: Any, actions: Any) -> tuple[Any, Any, View, Outcome]:
            key, step_key = jax.random.split(key)
            joint = {agent: actions[i] for i, agent in enumerate(self.agents)}
            # step_env() and not step(), which goes on to the next battle and loses the last observation
            observations, state, rewards, dones, _ = env.step_env(step_key, state, joint)
            alive = state.state.unit_alive
            allies, enemies = alive[:n_agents].any(), alive[n_agents:].any()
            # SMAX's "done" does not tell the step limit from a battle that is over
            outcome = Outcome(
                rewards[self.agents[0]], dones["__all__"], allies & ~enemies, dones["__all__"] & allies & enemies
            )
            return key, strong(state), view(state, observations), outcome

        by_agent = View(observations=1, masks=1, visible=0, alive=0)

        def choose(ended: Any, new: Any, old: Any) -> Any:
            return jax.tree.map(lambda n, o: jnp.where(ended.reshape(-1, *[1] * (n.ndim - 1)), n, o), new, old)

        self.begin = jax.jit(jax.vmap(begin_one, out_axes=(0, 0, by_agent)))
        self.advance = jax.jit(jax.vmap(advance_one, out_axes=(0, 0, by_agent, 0)))
        # Beginning anew everywhere and choosing saves to compile the beginning a second time
        self.choose = jax.jit(choose)
        self._jax = jax

    @cached_property
    def _structure(self) -> Any:
        keys = self._jax.ShapeDtypeStruct((1, 2), "uint32")
        return self._jax.eval_shape(self.begin, keys)[1]

    def leaves(self, states: Any) -> list[Any]:
        """
        :param states: SMAX's, of n copies
        :return: the arrays that they consist of, [n, ...] each
        """
        return self._jax.tree.leaves(states)

    def states(self, leaves: list[Any]) -> Any:
        """
        :param leaves: what ``leaves`` returned for the same map
        :return: the states
        :raises ValueError: if they are of another map
        """
        expected, structure = self._jax.tree.flatten(self._structure)
        wanted = [(leaf.shape[1:], leaf.dtype) for leaf in expected]
        given = [(leaf.shape[1:], leaf.dtype) for leaf in leaves]
        if wanted != given:
            raise ValueError("This is no state of a battle on this map: states fit the map that they were taken from.")
        return self._jax.tree.unflatten(structure, leaves)


@cache
def battle_program(config: BattleConfig) -> BattleProgram:
    """
    :param config: the rules
    :return: the program for them, made and compiled once however many environments use it
    """
    return BattleProgram(config)


def map_names() -> list[str]:
    """
    :return: the maps that SMAX knows, its own order
    """
    return list(_import_smax()[1])


@contextmanager
def _silence() -> Iterator[None]:
    """For jaxmarl's import, which prints, and which leaves sys.stdout and sys.stderr as they were when Python started."""
    before = sys.stdout, sys.stderr, sys.__stdout__
    sys.stdout = sys.__stdout__ = io.StringIO()  # type: ignore[misc, assignment]
    try:
        yield
    finally:
        sys.stdout, sys.stderr, sys.__stdout__ = before  # type: ignore[misc]


@cache
def _import_smax() -> tuple[Any, dict[str, Any]]:
    """
    :return: the class of battles against SMAX's scripted enemies, and its maps by name
    """
    with _silence():
        from jaxmarl.environments.smax import HeuristicEnemySMAX
        from jaxmarl.environments.smax.smax_env import MAP_NAME_TO_SCENARIO
    return HeuristicEnemySMAX, MAP_NAME_TO_SCENARIO
