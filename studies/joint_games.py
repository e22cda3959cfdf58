"""
Joint learners in the matrix games (docs/environments/matrix_games.md), whose exact answers are known.

    python -m studies.joint_games
    python -m studies.joint_games --algos qmix --games qtran-matrix --seeds 0 1

trains the YAML entries of zoo_configs, and prints for every seed the return of the greedy play and the joint values learned.
"""

import argparse
import time
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_belief import make_team_env
from sb3_belief.common.threads import use_threads
from sb3_belief.references.factorisation import ValueFactorisation
from sb3_belief.references.joint_vec_env import JointVecEnv
from sb3_belief.zoo.config import load_config

ALGOS = ("vdn", "qmix", "qplex", "qtran")
GAMES = ("two-step", "climbing", "penalty", "qtran-matrix", "qplex-matrix")


class Played(NamedTuple):
    """
    Result of one run.

    :param returned: Return of an episode of greedy play
    :param tables: Joint values by name: "start" of each first action in ``two-step``, there followed by those of its two
        tables; otherwise "payoffs" alone
    :param seconds: CPU seconds
    """

    returned: float
    tables: dict[str, np.ndarray]
    seconds: float


def play(algo: str, game: str, seed: int, env_kwargs: dict[str, Any] | None = None) -> Played:
    """
    Train the YAML entry of a game.

    :param algo: One of ``ALGOS``
    :param game: One of ``GAMES``
    :param seed: Seed of model and environment
    :param env_kwargs: Arguments of the game
    :return: What was learned
    """
    config = load_config(algo, game)

    def make_env(n_envs: int) -> JointVecEnv:
        return JointVecEnv(make_team_env(game, n_envs=n_envs, seed=seed, env_kwargs=env_kwargs))

    model = ValueFactorisation(config.policy, make_env(config.n_envs), seed=seed, **config.algo_kwargs)
    start = time.process_time()
    model.learn(config.n_timesteps)
    seconds = time.process_time() - start
    env = make_env(1)
    returned, _ = evaluate_policy(model, env, 1)
    assert isinstance(returned, float)
    return Played(returned, _two_step_tables(model, env) if game == "two-step" else _payoffs(model, env), seconds)


def _payoffs(model: ValueFactorisation, env: JointVecEnv) -> dict[str, np.ndarray]:
    return {"payoffs": _table(model, env.reset(), None)}


def _two_step_tables(model: ValueFactorisation, env: JointVecEnv) -> dict[str, np.ndarray]:
    tables = {}
    for first, name in enumerate(("2A", "2B")):
        obs = env.reset()
        tables["start"] = _table(model, obs, None).max(axis=1)
        _, state = model.predict(obs, deterministic=True)
        actions = np.array([[first, 0]])
        after, _, _, _ = env.step(actions)
        assert state is not None and isinstance(after, dict)
        tables[name] = _table(model, after, (state[0], np.eye(env.n_actions, dtype=np.float32)[actions]))
    return tables


def _table(model: ValueFactorisation, obs: dict[str, np.ndarray], state: tuple[np.ndarray, ...] | None) -> np.ndarray:
    """Return the joint values of all actions of two agents."""
    n = model.policy.net.agents.n_actions
    values = [model.policy.joint_values(obs, np.array([[i, j]]), state)[0] for i in range(n) for j in range(n)]
    return np.array(values).reshape(n, n)


def main() -> None:
    """Play, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algos", nargs="+", choices=ALGOS, default=ALGOS)
    parser.add_argument("--games", nargs="+", choices=GAMES, default=GAMES)
    parser.add_argument("--seeds", nargs="+", type=int, default=range(5))
    chosen = parser.parse_args()
    use_threads(1)
    for game in chosen.games:
        for algo in chosen.algos:
            for seed in chosen.seeds:
                played = play(algo, game, seed)
                values = "  ".join(f"{name} {np.round(table, 2).tolist()}" for name, table in played.tables.items())
                print(f"{game} {algo} seed {seed}: return {played.returned:g}  {values}  {played.seconds:.0f} s", flush=True)


if __name__ == "__main__":
    main()
