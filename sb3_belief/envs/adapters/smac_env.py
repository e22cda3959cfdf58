"""The PettingZoo environment that the adapters of SMAC and SMACv2 share."""

import warnings
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from sb3_belief.envs.base import BattleGame, ResetResult, StepResult, check_render_mode, require_render_mode

RENDER_MODES = ("human", "rgb_array")
NO_OP = 0
# How often the start of a battle is tried before reset() gives up
ATTEMPTS = 3


class StarCraft(BattleGame[np.ndarray]):
    """
    Team of units in StarCraft II against its built-in opponent, through the interface that SMAC and SMACv2 share.

    **Actions**, ``Discrete``: 0 no-op (the only action of dead agents, and only theirs), 1 stop, four directions, then those
    of the package, the last ones one for each target. The mask in ``infos[agent]["action_mask"]`` says which actions are
    possible next. The game refuses all others. The action of a dead agent is ignored.

    **Reward**: the team's reward, which all agents get, dead ones too. Dead agents stay in ``agents`` and are inactive. A
    death therefore does not end an agent's return, and there is no ``life_end``.

    **End**: terminated when the battle is over, with ``is_success`` if it is won. Truncated at the package's step limit, and
    if the connection to StarCraft II was lost. In that case the last observation is that of the step before, and there is no
    ``is_success``.

    **Visibility**: j is visible to i if i's observation after the step shows j. That equals the package's
    ``get_visibility_matrix()`` if all units see equally far and in all directions. Otherwise the matrix is wrong.

    **Seeds**: StarCraft II takes a seed only when it is launched, so ``reset(seed)`` launches it again.

    :param name: Id of the environment, for messages and ``versions()``
    :param launch: Callable that makes the package's environment from a seed or None. StarCraft II starts when that is reset
    :param extra_width: Number of observation entries that the package does not count
    :param render_mode: None, ``"human"`` or ``"rgb_array"``
    :raises ValueError: For any other render mode
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "starcraft", "render_modes": list(RENDER_MODES), "is_parallelizable": True}

    def __init__(self, name: str, launch: Callable[[int | None], Any], extra_width: int = 0, render_mode: str | None = None):
        self.render_mode = check_render_mode(render_mode, RENDER_MODES)
        self.name, self._launch = name, launch
        self.game: Any = launch(None)
        info = self.game.get_env_info()
        n_agents = info["n_agents"]
        self.n_actions, self.width = int(info["n_actions"]), int(info["obs_shape"]) + extra_width
        self.state_width = int(info["state_shape"])
        self.possible_agents = [f"agent_{i}" for i in range(n_agents)]
        self.agents: list[str] = []
        self.observation_spaces: dict[str, spaces.Space] = {
            agent: spaces.Box(-np.inf, np.inf, (self.width,), dtype=np.float32) for agent in self.possible_agents
        }
        self.action_spaces: dict[str, spaces.Space] = {
            agent: spaces.Discrete(self.n_actions) for agent in self.possible_agents
        }
        # Whether StarCraft II is running, and whether a battle has ended since the package's environment was made
        self._runs, self._saw_end = False, False
        self._obs = np.zeros((n_agents, self.width), dtype=np.float32)
        self._masks = np.ones((n_agents, self.n_actions), dtype=bool)
        self._visible = np.zeros((n_agents, n_agents - 1), dtype=bool)

    @property
    def action_names(self) -> tuple[str, ...]:
        """The names of the actions; those with a target heal it if the unit is a medic."""
        moves = ("no-op", "stop", "north", "south", "east", "west")
        return (*moves, *(f"target {k}" for k in range(self.n_actions - len(moves))))

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> ResetResult:
        """
        Start a battle.

        :param seed: Seed with which StarCraft II is launched again. With None a running one continues
        :param options: Not used
        :return: Observations and infos, by agent
        :raises RuntimeError: If StarCraft II repeatedly loses its connection
        """
        if seed is not None or self.game is None:
            self.close()
            self.game = self._launch(seed)
        self._read_game(self._begin())
        self.agents = list(self.possible_agents)
        self._visible = np.zeros_like(self._visible)
        return self._by_agent(self._obs), {
            agent: {"action_mask": self._masks[i]} for i, agent in enumerate(self.possible_agents)
        }

    def _begin(self) -> Any:
        """
        Start a battle in StarCraft II, with further attempts if the connection is lost.

        :return: The first observations of the battle, as the package returns them
        """
        for _ in range(ATTEMPTS):
            if self._runs and not self._saw_end:
                # Until its first battle has ended, the package launches StarCraft II at each reset without closing the one
                # that is running
                self.game.close()
            restarts = self.game.force_restarts
            self._runs = True
            try:
                answer = self.game.reset()
            except Exception:
                # force_restarts counts how often the package launched StarCraft II again after a lost connection. It may then
                # look for units that do not exist, so an error is only raised if the connection was not lost
                if self.game.force_restarts == restarts:
                    raise
            else:
                # A battle may lack units if StarCraft II was launched again while it started, so another one is started
                if self.game.force_restarts == restarts:
                    # SMACv2 returns None when it had to try twice
                    return self.game.get_obs() if answer is None else answer[0]
        raise RuntimeError(f"StarCraft II lost its connection at the beginning of {ATTEMPTS} battles of {self.name} in a row.")

    def step(self, actions: dict[str, int]) -> StepResult:
        """
        Advance the battle by one step.

        :param actions: Action of every agent, including dead ones
        :return: Observations, rewards, terminations, truncations and infos, by agent
        :raises ValueError: If an agent's action is missing, outside its space or impossible now, or if no episode is under way
        """
        self._require_episode()
        alive = ~self._masks[:, NO_OP]
        joint = [self._action_of(i, agent, actions) for i, agent in enumerate(self.possible_agents)]
        reward, ended, info = self.game.step(joint)
        # After a lost connection the package returns an empty info
        lost = bool(ended) and not info
        if lost:
            warnings.warn(
                f"{self.name}: StarCraft II lost its connection and was launched again; the episode is truncated here.",
                stacklevel=2,
            )
            self._visible = np.zeros_like(self._visible)
        else:
            # Only once per step, because SMACv2 may draw at random which enemies an agent sees
            self._read_game(self.game.get_obs())
            self._visible = self._allies_in_view()
            self._saw_end = self._saw_end or bool(ended)
        # The package reports "episode_limit" because of continuing_episode=True, see starcraft_kwargs
        truncated = lost or bool(info.get("episode_limit", False))
        infos: dict[str, dict[str, Any]] = {
            agent: {"active": bool(alive[i]), "action_mask": self._masks[i]} for i, agent in enumerate(self.possible_agents)
        }
        for agent, dead in zip(self.possible_agents, self._masks[:, NO_OP], strict=True):
            if dead:
                infos[agent]["next_active"] = False
        if ended:
            self.agents = []
            if not lost:
                for agent_info in infos.values():
                    agent_info["is_success"] = bool(info["battle_won"])
        return (
            self._by_agent(self._obs),
            dict.fromkeys(self.possible_agents, float(reward)),
            dict.fromkeys(self.possible_agents, bool(ended) and not truncated),
            dict.fromkeys(self.possible_agents, bool(ended) and truncated),
            infos,
        )

    @property
    def state_space(self) -> spaces.Box:
        """The space of :meth:`state`."""
        return spaces.Box(-np.inf, np.inf, (self.state_width,), dtype=np.float32)

    def state(self) -> np.ndarray:
        """
        Return the package's state of the battle, which knows all units. After a lost connection it is that of the next battle.

        :return: float32 [width]
        """
        return np.array(self.game.get_state(), dtype=np.float32)

    def visibility(self) -> dict[str, np.ndarray]:
        """
        Return whose action of the last step each agent could observe.

        :return: {agent: bool [n_others]}, the others in the order of ``possible_agents``. All False after ``reset`` and after
            a lost connection
        """
        return dict(zip(self.possible_agents, self._visible, strict=True))

    def versions(self) -> dict[str, str]:
        """
        Return the map and the version of StarCraft II. Results are only comparable within one version.

        :return: The map as ``"map"`` and the version as ``"starcraft2"``, which is ``"unknown"`` before the first launch
        """
        # The package offers no public access to the version
        config = getattr(self.game, "_run_config", None)
        version = getattr(config, "version", None)
        return {"map": self.name, "starcraft2": str(getattr(version, "game_version", None) or "unknown")}

    def render(self) -> Any:
        """
        Render the battle.

        :return: The result of the package's renderer
        :raises ValueError: If the environment was made without a render mode
        """
        return self.game.render(mode=require_render_mode(self.render_mode, RENDER_MODES))

    def close(self) -> None:
        """Close StarCraft II. ``reset`` launches it again."""
        if self.game is not None:
            self.game.close()
        self.game, self.agents = None, []
        self._runs = self._saw_end = False

    def _read_game(self, observations: Any) -> None:
        self._obs = np.array(observations, dtype=np.float32)
        self._masks = np.array(self.game.get_avail_actions(), dtype=bool)

    def _allies_in_view(self) -> np.ndarray:
        """
        Return which allies each agent's observation shows.

        Each ally has a block in the observation, which begins with 1 if the ally is seen.

        :return: bool [n, n-1]
        """
        n_enemies, enemy_width = self.game.get_obs_enemy_feats_size()
        n_others, width = self.game.get_obs_ally_feats_size()
        start = self.game.get_obs_move_feats_size() + n_enemies * enemy_width
        return self._obs[:, start : start + n_others * width : width] > 0

    def _by_agent(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        return dict(zip(self.possible_agents, rows, strict=True))

    def _action_of(self, i: int, agent: str, actions: dict[str, int]) -> int:
        action = self._checked_action(agent, actions)
        # Only dead agents may choose no-op
        if self._masks[i, NO_OP]:
            return NO_OP
        if not self._masks[i, action]:
            raise ValueError(
                f"{agent!r} cannot do action {action} now, possible are {np.flatnonzero(self._masks[i]).tolist()}. StarCraft"
                " accepts no others, so it needs a learner that heeds action masks: MaskableBeliefPPO or MaskablePPO."
            )
        return action


def starcraft_kwargs(name: str, env_kwargs: dict[str, Any]) -> dict[str, Any]:
    """
    Return the keyword arguments of the package's environment.

    :param name: Id of the environment, for messages
    :param env_kwargs: Keyword arguments from the user
    :return: The same together with those that the adapter needs
    :raises ValueError: For an argument that the adapter sets itself
    """
    if "seed" in env_kwargs:
        raise ValueError(f"{name} takes no argument 'seed': give it to make_team_env() or reset(), each copy gets its own.")
    if "continuing_episode" in env_kwargs:
        raise ValueError(f"{name} takes no argument 'continuing_episode': it is set to tell step limits from lost battles.")
    # Its only effect is that infos have "episode_limit"
    return {**env_kwargs, "continuing_episode": True}
