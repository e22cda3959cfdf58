"""A fake of SMACv2: the fake of SMAC with other units, positions and sight, behind a wrapper like that of the real package."""

import math
import random
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np

from tests.envs.adapters import fake_starcraft
from tests.envs.adapters.fake_starcraft import GENERATED, MAPS, SIGHT, CannotResetException, StarCraft2Env, Unit


class StarCraft2EnvV2(StarCraft2Env):
    """A fake of SMACv2's ``StarCraft2Env``, which overrides what differs from SMAC."""

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
        if fake_starcraft.FAULTS.missing_units:
            fake_starcraft.FAULTS.missing_units -= 1
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
        fake_starcraft.FAULTS.obs_calls += 1
        order = list(range(self.n_agents))
        random.shuffle(order)
        observations: list[Any] = [None] * self.n_agents
        for i in order:
            observations[i] = self.get_obs_agent(i)
        return observations


class TeamDistribution:
    """Units drawn, as in SMACv2, from a generator without a seed and shuffled by the process's own generator."""

    def __init__(self, config: dict[str, Any]):
        self.config, self.rng = config, np.random.default_rng()

    def generate(self) -> dict[str, Any]:
        team = list(self.rng.choice(self.config["unit_types"], self.config["n_units"], p=self.config["weights"]))
        random.shuffle(team)
        extra = self.rng.choice(self.config["unit_types"], self.config["n_enemies"] - self.config["n_units"])
        return {"team_gen": {"ally_team": team, "enemy_team": [*team, *extra], "id": 0}}


class UniformDistribution:
    """Uniform positions. As in SMACv2, another distribution holds this one."""

    def __init__(self, config: dict[str, Any]):
        self.config, self.rng = config, np.random.default_rng()

    def generate(self) -> np.ndarray:
        return self.rng.uniform(4, 20, size=(self.config["n_units"], 2))


class PositionDistribution:
    """Start positions drawn by an inner distribution. It has no generator of its own."""

    def __init__(self, config: dict[str, Any]):
        self.inner = UniformDistribution(config)

    def generate(self) -> dict[str, Any]:
        return {"ally_start_positions": {"item": self.inner.generate(), "id": 0}}


class StarCraftCapabilityEnvWrapper:
    """A fake of SMACv2's wrapper, which draws units and positions and resets the environment with them."""

    def __init__(self, **kwargs):
        self.distribution_config = kwargs["capability_config"]
        self.env_key_to_distribution_map: dict[str, Any] = {}
        kinds: dict[str, Any] = {"weighted_teams": TeamDistribution, "surrounded_and_reflect": PositionDistribution}
        for key, config in self.distribution_config.items():
            if key in ("n_units", "n_enemies"):
                continue
            # As in SMACv2, this writes into the caller's own dictionary
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
