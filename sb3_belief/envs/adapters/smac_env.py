"""What SMAC and SMACv2 have in common as PettingZoo environments."""

import warnings
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from sb3_belief.envs.base import BattleGame, check_render_mode, require_render_mode

RENDER_MODES = ("human", "rgb_array")
NO_OP = 0
# How often a battle is begun anew when StarCraft II fails to begin it
ATTEMPTS = 3


class StarCraft(BattleGame[np.ndarray]):
    """
    A team of units in StarCraft II against its built-in opponent, through the interface that SMAC and SMACv2 have in common.

    **Actions**, ``Discrete``: 0 no-op (all that the dead can do, and only they), 1 stop, four directions, then what the
    package adds, in the end one for each target. The mask in ``infos[agent]["action_mask"]`` says what is possible next; the
    game refuses the rest. What a dead agent chooses is not sent.

    **Reward**: the team's, the same for all, also for the dead, who stay among ``agents``, inactive. So a death ends nobody's
    return: there is no ``life_end``.

    **End**: terminated when the battle is over, ``is_success`` if it is won; truncated at the package's step limit, and where
    the connection to StarCraft II was lost. Then the last observation is that of the step before, and nobody says whether it
    was a success.

    **Visibility**: j is visible to i if i's observation after the step shows j. Where all see equally far and around
    themselves, that is the package's ``get_visibility_matrix()``; elsewhere the matrix is wrong.

    **Seeds**: StarCraft II takes a seed only when it is launched, so ``reset(seed)`` launches it anew.

    :param name: the id's name, for messages and ``versions()``
    :param launch: makes the package's environment from a seed (or None); StarCraft II starts when that is reset
    :param extra_width: how much wider the observations are than the package says
    :param render_mode: None, ``"human"`` or ``"rgb_array"``
    :raises ValueError: for another render mode
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "starcraft", "render_modes": list(RENDER_MODES), "is_parallelizable": True}

    def __init__(self, name: str, launch: Callable[[int | None], Any], extra_width: int = 0, render_mode: str | None = None):
        self.render_mode = check_render_mode(render_mode, RENDER_MODES)
        self.name, self._launch = name, launch
        self.game: Any = launch(None)
        info = self.game.get_env_info()
        n_agents = info["n_agents"]
        self.n_actions, self.width = int(info["n_actions"]), int(info["obs_shape"]) + extra_width
        self.possible_agents = [f"agent_{i}" for i in range(n_agents)]
        self.agents: list[str] = []
        self.observation_spaces: dict[str, spaces.Space] = {
            agent: spaces.Box(-np.inf, np.inf, (self.width,), dtype=np.float32) for agent in self.possible_agents
        }
        self.action_spaces: dict[str, spaces.Space] = {
            agent: spaces.Discrete(self.n_actions) for agent in self.possible_agents
        }
        # StarCraft II runs; the package has seen the end of a battle since it was made
        self._runs, self._saw_end = False, False
        self._obs = np.zeros((n_agents, self.width), dtype=np.float32)
        self._masks = np.ones((n_agents, self.n_actions), dtype=bool)
        self._visible = np.zeros((n_agents, n_agents - 1), dtype=bool)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, dict[str, Any]]]:
        """
        :param seed: StarCraft II is launched with it; None: it goes on
        :param options: not used
        :return: observations and infos, by agent
        :raises RuntimeError: if StarCraft II loses its connection again and again
        """
        if seed is not None or self.game is None:
            self.close()
            self.game = self._launch(seed)
        self._look(self._begin())
        self.agents = list(self.possible_agents)
        self._visible = np.zeros_like(self._visible)
        return self._by_agent(self._obs), {
            agent: {"action_mask": self._masks[i]} for i, agent in enumerate(self.possible_agents)
        }

    def _begin(self) -> Any:
        """
        :return: the first observations of a battle, as the package gives them
        """
        for _ in range(ATTEMPTS):
            if self._runs and not self._saw_end:
                # Until the end of its first battle the package launches StarCraft II at each reset, and leaves the one
                # that runs to itself
                self.game.close()
            restarts = self.game.force_restarts
            self._runs = True
            try:
                answer = self.game.reset()
            except Exception:
                # After a lost connection the package may ask for units that are not there
                if self.game.force_restarts == restarts:
                    raise
            else:
                # Nor is a battle to be trusted during whose beginning StarCraft II was launched anew: it may lack its units
                if self.game.force_restarts == restarts:
                    # SMACv2 returns None when it had to try twice
                    return self.game.get_obs() if answer is None else answer[0]
        raise RuntimeError(f"StarCraft II lost its connection at the beginning of {ATTEMPTS} battles of {self.name} in a row.")

    def step(
        self, actions: dict[str, int]
    ) -> tuple[dict[str, np.ndarray], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """
        :param actions: one for every agent, also for the dead
        :return: observations, rewards, terminations, truncations and infos, by agent
        :raises ValueError: if an agent's action is missing, outside its space or impossible now, or if no episode is under way
        """
        self._require_episode()
        alive = ~self._masks[:, NO_OP]
        joint = [self._action_of(i, agent, actions) for i, agent in enumerate(self.possible_agents)]
        reward, ended, told = self.game.step(joint)
        lost = bool(ended) and not told
        if lost:
            warnings.warn(
                f"{self.name}: StarCraft II lost its connection and was launched anew; the episode is cut off here.",
                stacklevel=2,
            )
            self._visible = np.zeros_like(self._visible)
        else:
            # Once per step: SMACv2 may draw who sees which enemy
            self._look(self.game.get_obs())
            self._visible = self._seen()
            self._saw_end = self._saw_end or bool(ended)
        # "episode_limit" is there because the package was made with continuing_episode=True, which does nothing else
        cut = lost or bool(told.get("episode_limit", False))
        infos: dict[str, dict[str, Any]] = {
            agent: {"active": bool(alive[i]), "action_mask": self._masks[i]} for i, agent in enumerate(self.possible_agents)
        }
        if ended:
            self.agents = []
            if not lost:
                for info in infos.values():
                    info["is_success"] = bool(told["battle_won"])
        return (
            self._by_agent(self._obs),
            dict.fromkeys(self.possible_agents, float(reward)),
            dict.fromkeys(self.possible_agents, bool(ended) and not cut),
            dict.fromkeys(self.possible_agents, bool(ended) and cut),
            infos,
        )

    def visibility(self) -> dict[str, np.ndarray]:
        """
        :return: whose action of the last step each agent could observe, {agent: bool [n_others]}, the others in the order of
            ``possible_agents``; all False after ``reset`` and a lost connection
        """
        return dict(zip(self.possible_agents, self._visible, strict=True))

    def versions(self) -> dict[str, str]:
        """
        Results are to be compared within one version of StarCraft II only.

        :return: the map as ``"map"`` and, once it was launched, the version of StarCraft II as ``"starcraft2"``
        """
        # The package does not say otherwise
        config = getattr(self.game, "_run_config", None)
        version = getattr(config, "version", None)
        return {"map": self.name, "starcraft2": str(getattr(version, "game_version", None) or "unknown")}

    def render(self) -> Any:
        """
        :return: what the package's renderer returns
        :raises ValueError: if the environment was made without a render mode
        """
        return self.game.render(mode=require_render_mode(self.render_mode, RENDER_MODES))

    def close(self) -> None:
        """End StarCraft II; ``reset`` launches it again."""
        if self.game is not None:
            self.game.close()
        self.game, self.agents = None, []
        self._runs = self._saw_end = False

    def _look(self, observations: Any) -> None:
        self._obs = np.array(observations, dtype=np.float32)
        self._masks = np.array(self.game.get_avail_actions(), dtype=bool)

    def _seen(self) -> np.ndarray:
        """
        :return: who is in whose observation, bool [n, n-1]: of each ally a block that begins with 1 if it is seen
        """
        n_enemies, enemy_width = self.game.get_obs_enemy_feats_size()
        n_others, width = self.game.get_obs_ally_feats_size()
        start = self.game.get_obs_move_feats_size() + n_enemies * enemy_width
        return self._obs[:, start : start + n_others * width : width] > 0

    def _by_agent(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        return dict(zip(self.possible_agents, rows, strict=True))

    def _action_of(self, i: int, agent: str, actions: dict[str, int]) -> int:
        action = self._checked_action(agent, actions)
        if self._masks[i, NO_OP]:
            return NO_OP
        if not self._masks[i, action]:
            raise ValueError(
                f"{agent!r} cannot do action {action} now, possible are {np.flatnonzero(self._masks[i]).tolist()}. StarCraft"
                " takes no others, so it needs a learner that heeds action masks: MaskableBeliefPPO or MaskablePPO."
            )
        return action


def checked(name: str, env_kwargs: dict[str, Any]) -> dict[str, Any]:
    """
    :param name: of the environment, for the message
    :param env_kwargs: what the user gave for the package's environment
    :return: the same with what the adapter needs
    :raises ValueError: for an argument that is not the user's to give
    """
    if "seed" in env_kwargs:
        raise ValueError(f"{name} takes no argument 'seed': give it to make_team_env() or reset(), each copy gets its own.")
    if "continuing_episode" in env_kwargs:
        raise ValueError(f"{name} takes no argument 'continuing_episode': it is how step limits are told from lost battles.")
    return {**env_kwargs, "continuing_episode": True}
