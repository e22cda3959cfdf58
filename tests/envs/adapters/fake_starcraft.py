"""
A fake of SMAC that needs no StarCraft II: the same class, methods and faults around a small battle, as in SMAC at d6aab33.

``fake_smacv2.py`` holds what SMACv2 (at 577ab5a) adds. ``test_fake_starcraft.py`` compares the signatures with those of the
real packages where these are installed.
"""

import math
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np

MAPS: dict[str, dict[str, Any]] = {
    "3m": {"n_agents": 3, "n_enemies": 3, "limit": 60, "unit_type_bits": 0},
    "2s3z": {"n_agents": 5, "n_enemies": 5, "limit": 120, "unit_type_bits": 2},
}
GENERATED: dict[str, dict[str, Any]] = {
    f"10gen_{race}": {"n_agents": 10, "n_enemies": 10, "limit": 200, "unit_type_bits": 3}
    for race in ("protoss", "terran", "zerg")
}
SIGHT = {"stalker": 10, "zealot": 9, "colossus": 10, "zergling": 8, "baneling": 8, "hydralisk": 9}
SIGHT |= {"marine": 9, "marauder": 10, "medivac": 11}
MOVES = {2: (0, 2), 3: (0, -2), 4: (2, 0), 5: (-2, 0)}


class ConnectionLost(Exception):
    """Error that pysc2 raises inside the packages."""


class CannotResetException(Exception):
    """Error that SMACv2 raises when units do not appear."""


@dataclass
class Process:
    """One StarCraft II process."""

    seed: int | None
    closed: bool = False


@dataclass
class Faults:
    """
    Faults that the fakes make, and a record of what they were asked.

    :param lost_steps: Numbers of the steps, counted over all battles from 1, at which the connection is lost
    :param lost_resets: Number of resets from now on at which the connection is lost
    :param missing_units: Number of resets of SMACv2 from now on that fail because units do not appear
    :param processes: All processes that were launched
    :param sent: Available actions of all units and the actions that they were sent, for each step
    :param n_steps: Number of steps so far
    :param obs_calls: Number of calls of ``get_obs`` so far
    """

    lost_steps: set[int] = field(default_factory=set)
    lost_resets: int = 0
    missing_units: int = 0
    processes: list[Process] = field(default_factory=list)
    sent: list[tuple[list[list[int]], list[int]]] = field(default_factory=list)
    n_steps: int = 0
    obs_calls: int = 0

    def running(self) -> list[Process]:
        """Return the processes that have not been closed."""
        return [process for process in self.processes if not process.closed]


FAULTS = Faults()


@dataclass
class Unit:
    """One unit of a battle."""

    pos: SimpleNamespace
    kind: str
    health: float = 45.0
    health_max: float = 45.0


class StarCraft2Env:
    """A fake of SMAC's ``StarCraft2Env``, with its arguments."""

    maps: ClassVar = MAPS

    def __init__(
        self,
        map_name="8m",
        step_mul=8,
        move_amount=2,
        difficulty="7",
        game_version=None,
        seed=None,
        continuing_episode=False,
        obs_all_health=True,
        obs_own_health=True,
        obs_last_action=False,
        obs_pathing_grid=False,
        obs_terrain_height=False,
        obs_instead_of_state=False,
        obs_timestep_number=False,
        state_last_action=True,
        state_timestep_number=False,
        reward_sparse=False,
        reward_only_positive=True,
        reward_death_value=10,
        reward_win=200,
        reward_defeat=0,
        reward_negative_scale=0.5,
        reward_scale=True,
        reward_scale_rate=20,
        replay_dir="",
        replay_prefix="",
        window_size_x=1920,
        window_size_y=1200,
        heuristic_ai=False,
        heuristic_rest=False,
        debug=False,
    ):
        params = self.maps[map_name]
        self.map_name, self.game_version, self._seed = map_name, game_version, seed
        self.n_agents, self.n_enemies = params["n_agents"], params["n_enemies"]
        self.episode_limit, self.unit_type_bits = params["limit"], params["unit_type_bits"]
        self.continuing_episode = continuing_episode
        self.obs_last_action, self.obs_timestep_number = obs_last_action, obs_timestep_number
        self.n_actions_move, self.n_actions_no_attack = 4, 6
        self.n_actions = self.n_actions_no_attack + self.n_enemies
        self.agents: dict[int, Unit] = {}
        self.enemies: dict[int, Unit] = {}
        self.force_restarts = self.battles_won = self.battles_game = self.timeouts = 0
        self._episode_count = self._episode_steps = 0
        self._sc2_proc: Process | None = None
        self._run_config: Any = None

    # Battles

    def _launch(self) -> None:
        self._sc2_proc = Process(self._seed)
        FAULTS.processes.append(self._sc2_proc)
        self._dice = np.random.default_rng(self._seed)
        self._run_config = SimpleNamespace(version=SimpleNamespace(game_version=self.game_version or "4.10.0"))

    def full_restart(self) -> None:
        assert self._sc2_proc is not None
        self._sc2_proc.closed = True
        self._launch()
        self.force_restarts += 1

    def _restart(self) -> None:
        assert self._sc2_proc is not None and not self._sc2_proc.closed, "units of a closed game cannot be killed"

    def reset(self):
        self._episode_steps = 0
        if self._episode_count == 0:
            self._launch()
        else:
            self._restart()
        self.last_action = np.zeros((self.n_agents, self.n_actions))
        if FAULTS.lost_resets:
            # As in SMAC, the units remain those of the previous battle, or there are none
            FAULTS.lost_resets -= 1
            self.full_restart()
        else:
            self.init_units()
        return self.get_obs(), self.get_state()

    def init_units(self) -> None:
        kinds = ["stalker"] * 2 + ["zealot"] * 3 if self.unit_type_bits else ["marine"] * self.n_agents
        self._place(kinds, kinds)

    def _place(self, allies: list[str], enemies: list[str]) -> None:
        def unit(kind: str, x: float) -> Unit:
            return Unit(SimpleNamespace(x=x + self._dice.uniform(-3, 3), y=16 + self._dice.uniform(-4, 4)), str(kind))

        self.agents = {i: unit(kind, 11) for i, kind in enumerate(allies)}
        self.enemies = {i: unit(kind, 21) for i, kind in enumerate(enemies)}

    def step(self, actions):
        actions_int = [int(a) for a in actions]
        self.last_action = np.eye(self.n_actions)[np.array(actions_int)]
        FAULTS.sent.append((self.get_avail_actions(), actions_int))
        orders = [self.get_agent_action(i, action) for i, action in enumerate(actions_int)]
        FAULTS.n_steps += 1
        if FAULTS.n_steps in FAULTS.lost_steps:
            self.full_restart()
            return 0, True, {}
        self._episode_steps += 1
        damage = sum(order() for order in orders)
        self._enemies_act()
        allies, enemies = (sum(u.health > 0 for u in side.values()) for side in (self.agents, self.enemies))
        info: dict[str, Any] = {
            "battle_won": False,
            "dead_allies": self.n_agents - allies,
            "dead_enemies": self.n_enemies - enemies,
        }
        reward, terminated = damage, False
        if not allies or not enemies:
            terminated = True
            self.battles_game += 1
            if allies:
                self.battles_won += 1
                info["battle_won"] = True
                reward += 200
        elif self._episode_steps >= self.episode_limit:
            terminated = True
            if self.continuing_episode:
                info["episode_limit"] = True
            self.battles_game += 1
            self.timeouts += 1
        if terminated:
            self._episode_count += 1
        return reward / 20, terminated, info

    def get_agent_action(self, a_id, action):
        avail_actions = self.get_avail_agent_actions(a_id)
        assert avail_actions[action] == 1, f"Agent {a_id} cannot perform action {action}"
        unit = self.get_unit_by_id(a_id)
        if action in MOVES:
            unit.pos.x += MOVES[action][0]
            unit.pos.y += MOVES[action][1]
        if action < self.n_actions_no_attack:
            return lambda: 0.0
        return lambda: self._hit(self.enemies[action - self.n_actions_no_attack], 9.0)

    @staticmethod
    def _hit(unit: Unit, damage: float) -> float:
        dealt = min(unit.health, damage)
        unit.health -= dealt
        return dealt

    def _enemies_act(self) -> None:
        for enemy in self.enemies.values():
            targets = [u for u in self.agents.values() if u.health > 0 and self._distance(u, enemy) < 9]
            if enemy.health > 0 and targets:
                self._hit(min(targets, key=lambda u: self._distance(u, enemy)), 1.5)

    @staticmethod
    def _distance(a: Unit, b: Unit) -> float:
        return math.hypot(a.pos.x - b.pos.x, a.pos.y - b.pos.y)

    # Queries

    def unit_shoot_range(self, agent_id):
        return 6

    def unit_sight_range(self, agent_id):
        return 9

    def get_unit_by_id(self, a_id):
        return self.agents[a_id]

    def get_total_actions(self):
        return self.n_actions

    def get_avail_agent_actions(self, agent_id):
        unit = self.get_unit_by_id(agent_id)
        if unit.health <= 0:
            return [1] + [0] * (self.n_actions - 1)
        avail = [0, 1] + [0] * (self.n_actions - 2)
        for action, (dx, dy) in MOVES.items():
            avail[action] = int(0 < unit.pos.x + dx < 32 and 0 < unit.pos.y + dy < 32)
        for e_id, enemy in self.enemies.items():
            near = self._distance(unit, enemy) <= self.unit_shoot_range(agent_id)
            avail[self.n_actions_no_attack + e_id] = int(near and enemy.health > 0)
        return avail

    def get_avail_actions(self):
        return [self.get_avail_agent_actions(i) for i in range(self.n_agents)]

    def get_obs_move_feats_size(self):
        return 4

    def get_obs_enemy_feats_size(self):
        return self.n_enemies, 5 + self.unit_type_bits

    def get_obs_ally_feats_size(self):
        return self.n_agents - 1, 5 + self.unit_type_bits + self.obs_last_action * self.n_actions

    def get_obs_own_feats_size(self):
        # As in SMAC, the time step is counted here although it is appended separately
        return 1 + self.unit_type_bits + self.obs_timestep_number

    def get_obs_size(self):
        (n_enemies, enemy), (n_allies, ally) = self.get_obs_enemy_feats_size(), self.get_obs_ally_feats_size()
        return self.get_obs_move_feats_size() + n_enemies * enemy + n_allies * ally + self.get_obs_own_feats_size()

    def _sees(self, agent_id: int, other: Unit) -> bool:
        return self._distance(self.agents[agent_id], other) < self.unit_sight_range(agent_id)

    def get_obs_agent(self, agent_id):
        unit = self.get_unit_by_id(agent_id)
        sight = self.unit_sight_range(agent_id)
        move = np.zeros(self.get_obs_move_feats_size(), dtype=np.float32)
        enemies = np.zeros(self.get_obs_enemy_feats_size(), dtype=np.float32)
        allies = np.zeros(self.get_obs_ally_feats_size(), dtype=np.float32)
        own = np.zeros(self.get_obs_own_feats_size(), dtype=np.float32)
        if unit.health > 0:
            avail = self.get_avail_agent_actions(agent_id)
            move[:4] = avail[2:6]
            own[0] = unit.health / unit.health_max
            others = [(j, ally) for j, ally in self.agents.items() if j != agent_id]
            for rows, units, first in ((enemies, list(self.enemies.items()), None), (allies, others, 1.0)):
                for row, (j, other) in zip(rows, units, strict=True):
                    if other.health > 0 and self._sees(agent_id, other):
                        row[0] = avail[self.n_actions_no_attack + j] if first is None else first
                        row[1] = self._distance(unit, other) / sight
                        row[2:4] = (other.pos.x - unit.pos.x) / sight, (other.pos.y - unit.pos.y) / sight
                        row[4] = other.health / other.health_max
                        if first is not None and self.obs_last_action:
                            row[5 + self.unit_type_bits :] = self.last_action[j]
        obs = np.concatenate([move, enemies.ravel(), allies.ravel(), own])
        return np.append(obs, self._episode_steps / self.episode_limit) if self.obs_timestep_number else obs

    def get_obs(self):
        FAULTS.obs_calls += 1
        return [self.get_obs_agent(i) for i in range(self.n_agents)]

    def get_state(self):
        state = np.zeros(self.get_state_size(), dtype=np.float32)
        units = [*self.agents.values(), *self.enemies.values()]
        state[: len(units)] = [unit.health / unit.health_max for unit in units]
        return state

    def get_state_size(self):
        return 4 * self.n_agents + 3 * self.n_enemies

    def get_visibility_matrix(self):
        arr = np.zeros((self.n_agents, self.n_agents + self.n_enemies), dtype=bool)
        for i, unit in self.agents.items():
            sight = self.unit_sight_range(i)
            for e_id, enemy in self.enemies.items():
                near = self._distance(unit, enemy) < sight
                arr[i, self.n_agents + e_id] = unit.health > 0 and enemy.health > 0 and near
            # As in SMAC, both entries of a pair use the sight range of its first unit
            for j in range(i + 1, self.n_agents):
                other = self.agents[j]
                near = self._distance(unit, other) < sight
                arr[i, j] = arr[j, i] = unit.health > 0 and other.health > 0 and near
        return arr

    def get_env_info(self):
        return {
            "state_shape": self.get_state_size(),
            "obs_shape": self.get_obs_size(),
            "n_actions": self.get_total_actions(),
            "n_agents": self.n_agents,
            "episode_limit": self.episode_limit,
        }

    def get_stats(self):
        return {"battles_won": self.battles_won, "battles_game": self.battles_game, "timeouts": self.timeouts}

    def render(self, mode="human"):
        return np.zeros((4, 4, 3), dtype=np.uint8) if mode == "rgb_array" else None

    def seed(self):
        return self._seed

    def save_replay(self):
        pass

    def close(self):
        if self._sc2_proc:
            self._sc2_proc.closed = True
