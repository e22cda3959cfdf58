"""
The games that prove a belief dynamic (sb3_belief.envs.SwitchingConvention), for all variants and seeds.

    python -m studies.games --jobs 2
    python -m studies.games --games swap --beliefs dynamic none --seeds 0

trains the YAML entries of zoo_configs/belief_ppo.yml, the same for all variants, and prints the success of every seed for each
game and variant beside the best possible one. Success is the share of steps in which the follower plays what the leader plays;
by chance it is 1/4.
"""

import argparse
import itertools
import math
import time
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_belief import BeliefPPO, Team, make_team_env
from sb3_belief.team import observing
from sb3_belief.team.observing import ObservingVecEnv
from sb3_belief.zoo.config import load_config
from sb3_belief.zoo.train import TrainOptions, make_env, make_team

FOLLOWER = "follower"
HISTORY = ("dynamic", "context")
BELIEFS = (*HISTORY, "variational", "static", "wide", "none")
#: Beyond the paper, and played on request: --beliefs adaptive
ADAPTIVE = "adaptive"
# No training uses conventions with seeds from here on
FRESH_SEEDS = 1_000_000


@dataclass(frozen=True)
class Game:
    """
    A game, and how it is played.

    :param env_id: The environment, whose YAML entry is trained
    :param best: The best possible success
    :param what: What is measured
    :param beliefs: The variants of the belief that are compared
    :param rollouts: Number of rollouts of the training, None for that of the YAML entry
    :param env_kwargs: Arguments of the environment that differ from the YAML entry
    """

    env_id: str
    best: float
    what: str
    beliefs: tuple[str, ...] = BELIEFS
    rollouts: int | None = None
    env_kwargs: tuple[str, ...] = ()


GAMES = {
    "swap": Game(
        "convention-swap", 1.0, "T1: weights frozen, each of the 24 conventions drawn afresh and watched for 800 steps"
    ),
    "watch-act": Game("convention-watch-act", 1.0, "T2: second rollout of each of the last 20 conventions"),
    "redraw": Game("convention-redraw", 0.85, "T3, K=5: all rollouts of the last 5 conventions"),
    "redraw-each": Game("convention-redraw", 0.25, "T3, K=1, control: all rollouts", rollouts=50, env_kwargs=("K:1",)),
    "hidden": Game(
        "convention-swap", 0.25, "T1, control: the leader is never visible", HISTORY, 50, env_kwargs=("leader_visible:false",)
    ),
    "stationary": Game(
        "convention-redraw",
        1.0,
        "control: the leader never changes; the last 10 rollouts",
        ("dynamic", "none"),
        rollouts=50,
        env_kwargs=("K:null",),
    ),
}


class Played(NamedTuple):
    """
    Result of one run.

    :param success: Success as the game measures it
    :param history_gain: Mean over the last quarter of the training, of the rollouts whose history shows their own convention;
        0 for a belief without a history
    :param curve: Success in each rollout of the training
    :param seconds: CPU seconds
    """

    success: float
    history_gain: float
    curve: np.ndarray
    seconds: float


class _Record(BaseCallback):
    """Callback that records the success of each step and the history gain of each rollout."""

    def __init__(self) -> None:
        super().__init__()
        self.hits: list[float] = []
        self.gains: list[float] = []

    def _on_step(self) -> bool:
        # Actions are compared, since not every game gives rewards in all of its steps
        actions, leader = self.locals["actions"], np.array([info["scripted_actions"] for info in self.locals["infos"]])
        self.hits.append(float((actions[FOLLOWER] == leader.argmax(axis=1)).mean()))
        return True

    def _on_rollout_start(self) -> None:
        # The value that the last update logged
        model = self.model.agents[FOLLOWER]  # type: ignore[attr-defined]
        self.gains.append(float(model.logger.name_to_value.get("belief/history_gain", 0.0)))


def play(name: str, belief: str, seed: int, rollouts: int | None = None) -> Played:
    """
    Train a team in a game and measure its success.

    :param name: A key of ``GAMES``
    :param belief: The variant of the belief
    :param seed: Seed of the team, the cues and the conventions
    :param rollouts: Number of rollouts of the training, instead of the game's
    :return: The result
    """
    th.set_num_threads(1)
    start = time.process_time()
    game = GAMES[name]
    kwargs = [*game.env_kwargs, f"seed:{seed}"]
    config = load_config("belief_ppo", game.env_id, params=[f"belief:{belief}"], env_kwargs=kwargs)
    n_steps, rollouts = config.algo_kwargs["n_steps"], rollouts or game.rollouts
    timesteps = config.n_timesteps if rollouts is None else rollouts * n_steps * config.n_envs
    env = make_env(config, config.n_envs, seed)
    team = make_team(config, TrainOptions(verbose=0), env, seed)
    record = _Record()
    team.learn(timesteps, callback=record)
    record.on_rollout_start()

    curve = np.array(record.hits).reshape(-1, n_steps).mean(axis=1)
    n_rollouts = len(curve)
    lifetime = env.get_attr("config")[0].K or n_rollouts
    phase = np.arange(n_rollouts) % lifetime
    if name in ("swap", "hidden"):
        success = fresh_conventions(team, config.n_envs, n_steps, game.env_kwargs)
    elif name == "watch-act":
        success = curve[phase == 1][-20:].mean()
    else:
        success = curve[-{"redraw": 25, "redraw-each": 50, "stationary": 10}[name] :].mean()
    # gains[k] was measured in the update on rollout k - 1, whose history comes from the rollout before that
    gains = np.array(record.gains[1:])
    own = (phase > 0) & (np.arange(n_rollouts) >= 0.75 * n_rollouts)
    gain = gains[own].mean() if own.any() else gains[-n_rollouts // 4 :].mean()
    return Played(float(success), float(gain), curve, time.process_time() - start)


def fresh_conventions(team: Team, n_envs: int, n_steps: int, env_kwargs: Iterable[str]) -> float:
    """
    Measure how an agent that no longer learns adapts to new teammates: it watches them, and only its history changes.

    :param team: A trained team
    :param n_envs: Number of copies of the environment
    :param n_steps: Number of steps of watching, and then of acting
    :param env_kwargs: Arguments of the game's environment
    :return: Success of greedy actions over all conventions, each from a seed that the training did not use
    """
    model: BeliefPPO = team.agents[FOLLOWER]  # type: ignore[assignment]
    weights = {name: value.clone() for name, value in model.policy.named_parameters()}
    visible = "leader_visible:false" not in env_kwargs
    remembers = model.belief in (*HISTORY, ADAPTIVE)
    hits = []
    met: set[tuple[int, ...]] = set()
    for seed in itertools.count(FRESH_SEEDS):
        fresh: dict[str, Any] = {"K": None, "seed": seed, "rollout_steps": n_steps, "leader_visible": visible}
        env = make_team_env("convention-swap", n_envs=n_envs, seed=seed, env_kwargs=fresh)
        convention = tuple(env.get_attr("convention")[0])
        # Each convention once: over all of them together, no policy without a history is better than chance
        if convention in met:
            continue
        met.add(convention)
        # It remembers nothing of the steps in which it acts, of which an adaptive belief could make use
        with observing(team, env) if remembers else nullcontext(env) as watched:
            obs: Any = watched.reset()
            for step in range(2 * n_steps):
                watches = step < n_steps
                if isinstance(watched, ObservingVecEnv):
                    watched.is_open = watches
                actions, _ = team.predict(obs, deterministic=not watches)
                obs, _, _, infos = watched.step(actions)  # type: ignore[arg-type]
                leader = np.array([info["scripted_actions"] for info in infos])
                if not watches:
                    hits.append(float((actions[FOLLOWER] == leader.argmax(axis=1)).mean()))
        env.close()
        if len(met) == math.factorial(len(convention)):
            break
    assert all(th.equal(value, weights[name]) for name, value in model.policy.named_parameters())
    return float(np.mean(hits))


def play_all(
    names: Iterable[str], beliefs: Iterable[str], seeds: Iterable[int], jobs: int = 1, rollouts: int | None = None
) -> dict[tuple[str, str], list[Played]]:
    """
    Play games with several variants and seeds.

    :param names: Keys of ``GAMES``
    :param beliefs: Variants of the belief; each game is played with those among them that it compares
    :param seeds: Seeds of the runs
    :param jobs: Number of processes; with one it is this one that plays
    :param rollouts: Number of rollouts of the training, instead of the games'
    :return: ``{(game, variant): [result of each seed]}``
    """
    beliefs, seeds = list(beliefs), list(seeds)
    pairs = [(name, belief) for name in names for belief in (*GAMES[name].beliefs, ADAPTIVE) if belief in beliefs]
    runs = [(name, belief, seed, rollouts) for name, belief in pairs for seed in seeds]
    if jobs == 1:
        results = [play(*run) for run in runs]
    else:
        with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
            results = list(pool.map(play, *zip(*runs, strict=True)))
    return {pair: results[i * len(seeds) : (i + 1) * len(seeds)] for i, pair in enumerate(pairs)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--games", nargs="+", default=list(GAMES), choices=list(GAMES))
    parser.add_argument("--beliefs", nargs="+", default=list(BELIEFS), choices=(*BELIEFS, ADAPTIVE))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3, 4])
    parser.add_argument("--jobs", type=int, default=1)
    args = parser.parse_args()
    total = 0.0
    for name in args.games:
        print(f"\n{name}: {GAMES[name].what}; best possible: {GAMES[name].best}")
        for (_, belief), results in play_all([name], args.beliefs, args.seeds, args.jobs).items():
            values = "  ".join(f"{result.success:.3f}" for result in results)
            mean, gain = np.mean([r.success for r in results]), np.mean([r.history_gain for r in results])
            seconds = sum(result.seconds for result in results)
            total += seconds
            print(f"  {belief:<12} {values}   mean {mean:.3f}   history gain {gain:+.3f}   {seconds:4.0f} CPU s", flush=True)
    print(f"\n{total / 60:.1f} CPU minutes")


if __name__ == "__main__":
    main()
