"""
SMAC and SMACv2 without StarCraft II: the same classes, methods, arguments and answers, and the same faults, around a small
battle of its own. What is imitated is SMAC at d6aab33 and SMACv2 at 577ab5a; ``test_smac.py`` compares the signatures with
the real packages where these are installed.
"""

import math
import random
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import ModuleType, SimpleNamespace
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
    """What pysc2 raises inside the packages."""


class CannotResetException(Exception):
    """SMACv2's, when units do not appear."""


@dataclass
class Process:
    """One StarCraft II."""

    seed: int | None
    closed: bool = False


@dataclass
class Faults:
    """
    What goes wrong, and what was seen.

    :param lost_steps: at which of all steps the connection is lost
    :param lost_resets: how many resets lose it from now on
    :param missing_units: how many resets of SMACv2 fail for want of units from now on
    """

    lost_steps: set[int] = field(default_factory=set)
    lost_resets: int = 0
    missing_units: int = 0
    processes: list[Process] = field(default_factory=list)
    sent: list[tuple[list[list[int]], list[int]]] = field(default_factory=list)
    n_steps: int = 0
    obs_calls: int = 0

    def running(self) -> list[Process]:
        """
        :return: the StarCraft II that nobody has closed
        """
        return [process for process in self.processes if not process.closed]


FAULTS = Faults()


@dataclass
class Unit:
    """One unit."""

    pos: SimpleNamespace
    kind: str
    health: float = 45.0
    health_max: float = 45.0


class StarCraft2Env:
    """SMAC's."""

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
            # The units are those of the battle before, or none
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

    # What can be asked

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
        # The time step is counted here and appended besides
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
        return np.zeros(self.get_state_size(), dtype=np.float32)

    def get_state_size(self):
        return 4 * self.n_agents + 3 * self.n_enemies

    def get_visibility_matrix(self):
        arr = np.zeros((self.n_agents, self.n_agents + self.n_enemies), dtype=bool)
        for i, unit in self.agents.items():
            sight = self.unit_sight_range(i)
            for e_id, enemy in self.enemies.items():
                near = self._distance(unit, enemy) < sight
                arr[i, self.n_agents + e_id] = unit.health > 0 and enemy.health > 0 and near
            # Filled symmetrically with the sight range of the first of the two
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


class StarCraft2EnvV2(StarCraft2Env):
    """SMACv2's, as far as it differs."""

    maps: ClassVar = {**MAPS, **GENERATED}

    def __init__(
        self,
        map_name="8m",
        obs_own_pos=False,
        obs_starcraft=True,
        conic_fov=False,
        num_fov_actions=12,
        use_unit_ranges=False,
        min_attack_range=2,
        kill_unit_step_mul=2,
        fully_observable=False,
        capability_config={},  # noqa: B006 (as there)
        prob_obs_enemy=1.0,
        action_mask=True,
        **kwargs,
    ):
        super().__init__(map_name, **kwargs)
        team = capability_config.get("team_gen")
        if team:
            self.n_agents, self.n_enemies = team["n_units"], team["n_enemies"]
        self.use_unit_ranges, self.conic_fov, self.obs_own_pos = use_unit_ranges, conic_fov, obs_own_pos
        self.n_fov_actions = num_fov_actions if conic_fov else 0
        self.n_actions_no_attack = 6 + self.n_fov_actions
        self.n_actions = self.n_actions_no_attack + self.n_enemies

    def reset(self, episode_config={}):  # noqa: B006 (as there)
        self.episode_config = episode_config
        self.fov_directions = np.tile([1.0, 0.0], (self.n_agents, 1))
        return super().reset()

    def init_units(self) -> None:
        if FAULTS.missing_units:
            FAULTS.missing_units -= 1
            raise CannotResetException("waited for units to spawn and they didn't")
        team = self.episode_config["team_gen"]
        self._place(team["ally_team"], team["enemy_team"])
        for i, (x, y) in enumerate(self.episode_config["ally_start_positions"]["item"]):
            self.agents[i].pos = SimpleNamespace(x=float(x), y=float(y))

    def unit_sight_range(self, agent_id):
        return SIGHT[self.agents[agent_id].kind] if self.use_unit_ranges else 9

    def _sees(self, agent_id: int, other: Unit) -> bool:
        if not super()._sees(agent_id, other):
            return False
        if not self.conic_fov:
            return True
        unit, (look_x, look_y) = self.agents[agent_id], self.fov_directions[agent_id]
        turn = math.atan2(other.pos.y - unit.pos.y, other.pos.x - unit.pos.x) - math.atan2(look_y, look_x)
        return bool(abs((turn + np.pi) % (2 * np.pi) - np.pi) < np.pi / self.n_fov_actions)

    def get_agent_action(self, a_id, action):
        if 6 <= action < self.n_actions_no_attack:
            turn = 2 * np.pi * (action - 6) / self.n_fov_actions
            self.fov_directions[a_id] = np.cos(turn), np.sin(turn)
            return lambda: 0.0
        return super().get_agent_action(a_id, action)

    def get_avail_agent_actions(self, agent_id):
        avail = super().get_avail_agent_actions(agent_id)
        if not avail[0] and self.conic_fov:
            avail[6 : self.n_actions_no_attack] = [1] * self.n_fov_actions
        return avail

    def get_obs_own_feats_size(self):
        return 1 + self.unit_type_bits + 2 * self.conic_fov + 2 * self.obs_own_pos

    def get_obs_size(self):
        return super().get_obs_size() + self.obs_timestep_number

    def get_obs(self):
        FAULTS.obs_calls += 1
        order = list(range(self.n_agents))
        random.shuffle(order)
        observations: list[Any] = [None] * self.n_agents
        for i in order:
            observations[i] = self.get_obs_agent(i)
        return observations


class TeamDistribution:
    """As SMACv2's: from a generator without a seed, and shuffled by the process's."""

    def __init__(self, config: dict[str, Any]):
        self.config, self.rng = config, np.random.default_rng()

    def generate(self) -> dict[str, Any]:
        team = list(self.rng.choice(self.config["unit_types"], self.config["n_units"], p=self.config["weights"]))
        random.shuffle(team)
        extra = self.rng.choice(self.config["unit_types"], self.config["n_enemies"] - self.config["n_units"])
        return {"team_gen": {"ally_team": team, "enemy_team": [*team, *extra], "id": 0}}


class UniformDistribution:
    """Positions; it lies inside of another, as in SMACv2."""

    def __init__(self, config: dict[str, Any]):
        self.config, self.rng = config, np.random.default_rng()

    def generate(self) -> np.ndarray:
        return self.rng.uniform(4, 20, size=(self.config["n_units"], 2))


class PositionDistribution:
    """It has no generator of its own."""

    def __init__(self, config: dict[str, Any]):
        self.inner = UniformDistribution(config)

    def generate(self) -> dict[str, Any]:
        return {"ally_start_positions": {"item": self.inner.generate(), "id": 0}}


class StarCraftCapabilityEnvWrapper:
    """SMACv2's."""

    def __init__(self, **kwargs):
        self.distribution_config = kwargs["capability_config"]
        self.env_key_to_distribution_map: dict[str, Any] = {}
        kinds: dict[str, Any] = {"weighted_teams": TeamDistribution, "surrounded_and_reflect": PositionDistribution}
        for key, config in self.distribution_config.items():
            if key in ("n_units", "n_enemies"):
                continue
            # The caller's own dictionary is written into
            assert "env_key" not in config, "used twice"
            config |= {"env_key": key, **{n: self.distribution_config[n] for n in ("n_units", "n_enemies")}}
            self.env_key_to_distribution_map[key] = kinds[config["dist_type"]](config)
        self.env = StarCraft2EnvV2(**kwargs)

    def reset(self):
        try:
            reset_config: dict[str, Any] = {}
            for distribution in self.env_key_to_distribution_map.values():
                reset_config |= distribution.generate()
            return self.env.reset(reset_config)
        except CannotResetException:
            self.reset()

    def __getattr__(self, name):
        if hasattr(self.env, name):
            return getattr(self.env, name)
        raise AttributeError


@contextmanager
def installed() -> Iterator[Faults]:
    """
    Put the fakes where the real packages would be.

    :return: what goes wrong from now on
    """
    global FAULTS
    FAULTS = Faults()
    contents: dict[str, dict[str, Any]] = {
        "smac": {},
        "smac.env": {"StarCraft2Env": StarCraft2Env},
        "smac.env.starcraft2": {},
        "smac.env.starcraft2.maps": {},
        "smac.env.starcraft2.maps.smac_maps": {"get_smac_map_registry": lambda: MAPS},
        "smacv2": {},
        "smacv2.env": {},
        "smacv2.env.starcraft2": {},
        "smacv2.env.starcraft2.wrapper": {"StarCraftCapabilityEnvWrapper": StarCraftCapabilityEnvWrapper},
    }
    before = {name: sys.modules.get(name) for name in contents}
    for name, members in contents.items():
        module = ModuleType(name)
        vars(module).update(members)
        sys.modules[name] = module
    try:
        yield FAULTS
    finally:
        for name, module_before in before.items():
            if module_before is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module_before
