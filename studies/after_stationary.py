"""
Does an agent still adapt after it has learned beside one and the same teammate for a long time (issue 20)?

    python -m studies.after_stationary --jobs 2

A follower first learns among conventions that change every five rollouts (convention-redraw, the entry of
zoo_configs/belief_ppo.yml), then for 200 rollouts beside one leader who never changes. Then weights are frozen and the leader
is swapped for each of the other 23 conventions: success with the memory as it is, and after 800 observed steps of the new one.
By chance it is 1/4. The share recovered is that of what the swap has cost.
"""

import argparse
import itertools
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, NamedTuple

import numpy as np
import torch as th

from sb3_belief import Team, make_team_env
from sb3_belief.team import observing
from sb3_belief.zoo.config import load_config
from sb3_belief.zoo.train import TrainOptions, make_env, make_team

_ADAPTIVE = ("belief:adaptive", "action_loss:cross_entropy")
ARMS: dict[str, tuple[str, ...]] = {
    "dynamic": (),
    "adaptive": (*_ADAPTIVE, "belief_replay:0"),
    "dropout": (*_ADAPTIVE, "belief_replay:0", "history_dropout:0.1"),
    "replay": (*_ADAPTIVE, "belief_replay:16"),
    "both": (*_ADAPTIVE, "belief_replay:16", "history_dropout:0.1"),
}
STATIONARY_ROLLOUTS = 200
OBSERVED_STEPS = 800
N_CONVENTIONS = 24
# No training uses conventions with seeds from here on
_FRESH_SEEDS = 1_000_000


class Swap(NamedTuple):
    """
    Result of one run, in success.

    :param changing: In the last 100 episodes among changing conventions
    :param stationary: Beside the leader who never changed, before the swap
    :param swapped: Beside the others, with the memory as it was
    :param observed: Beside the others, after 800 observed steps of each
    :param seconds: CPU seconds
    """

    changing: float
    stationary: float
    swapped: float
    observed: float
    seconds: float

    @property
    def recovered(self) -> float:
        """Share of what the swap has cost that observing has brought back."""
        return (self.observed - self.swapped) / (self.stationary - self.swapped)


def _leader(seed: int, n_envs: int, rollout_steps: int) -> Any:
    """Return an environment whose leader never changes."""
    kwargs = {"K": None, "seed": seed, "rollout_steps": rollout_steps}
    return make_team_env("convention-redraw", n_envs=n_envs, seed=seed, env_kwargs=kwargs)


def _success(team: Team, env: Any, n_steps: int) -> float:
    """Return the success of greedy actions over a number of steps of each copy."""
    obs, rewards = env.reset(), []
    for _ in range(n_steps):
        obs, reward, _, _ = env.step(team.predict(obs, deterministic=True)[0])
        rewards.append(reward.mean())
    return float(np.mean(rewards))


def play(arm: str, seed: int, rollouts: int | None = None) -> Swap:
    """
    Train a team, and swap its leader.

    :param arm: A key of ``ARMS``
    :param seed: Seed of the team, the cues and the conventions
    :param rollouts: Number of rollouts of each of the two trainings; None for that of the entry, and 200
    :return: The result
    """
    th.set_num_threads(1)
    start = time.process_time()
    config = load_config("belief_ppo", "convention-redraw", params=list(ARMS[arm]), env_kwargs=[f"seed:{seed}"])
    n_steps, n_envs = config.algo_kwargs["n_steps"], config.n_envs
    env = make_env(config, n_envs, seed)
    team = make_team(config, TrainOptions(verbose=0), env, seed)
    team.learn(config.n_timesteps if rollouts is None else rollouts * n_steps * n_envs)
    changing = float(np.mean([info["r"] for info in team.ep_info_buffer or []])) / n_steps
    home = _leader(_FRESH_SEEDS - 1 - seed, n_envs, n_steps)
    team.set_env(home)
    team.learn((rollouts or STATIONARY_ROLLOUTS) * n_steps * n_envs, reset_num_timesteps=False)
    stationary = _success(team, _leader(_FRESH_SEEDS - 1 - seed, n_envs, n_steps), n_steps)
    met = {tuple(home.get_attr("convention")[0])}
    swapped, observed = [], []
    for fresh in itertools.count(_FRESH_SEEDS):
        other = _leader(fresh, n_envs, n_steps)
        convention = tuple(other.get_attr("convention")[0])
        if convention in met:
            continue
        met.add(convention)
        swapped.append(_success(team, other, n_steps))
        with observing(team, other, most_steps=OBSERVED_STEPS) as watched:
            while watched.steps["follower"] < OBSERVED_STEPS:
                _success(team, watched, n_steps)
            watched.is_open = False
            observed.append(_success(team, watched, n_steps))
        if len(met) == N_CONVENTIONS:
            break
    return Swap(changing, stationary, float(np.mean(swapped)), float(np.mean(observed)), time.process_time() - start)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arms", nargs="+", default=list(ARMS), choices=list(ARMS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[20, 21, 22, 23, 24])
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--rollouts", type=int, help="of each of the two trainings, for a quick look")
    args = parser.parse_args()
    runs = list(itertools.product(args.arms, args.seeds))
    with ProcessPoolExecutor(args.jobs, mp_context=get_context("spawn")) as pool:
        for (arm, seed), swap in zip(
            runs, pool.map(play, *zip(*((*run, args.rollouts) for run in runs), strict=True)), strict=True
        ):
            print(
                f"{arm:<10} seed {seed}: changing {swap.changing:.3f}, stationary {swap.stationary:.3f},"
                f" swapped {swap.swapped:.3f}, observed {swap.observed:.3f}, recovered {swap.recovered:.2f},"
                f" {swap.seconds:.0f} CPU s",
                flush=True,
            )


if __name__ == "__main__":
    main()
