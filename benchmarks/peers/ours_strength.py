"""
What a team of ours has learned of simple_spread after so many steps, run by ``benchmarks.strength`` as BenchMARL's program is.

    python -m benchmarks.peers.ours_strength ippo --seed 0 --steps 100000
"""

from typing import Any

import torch as th
from stable_baselines3.common.evaluation import evaluate_policy

from benchmarks.peers.spread_settings import (
    GAMMA,
    LENGTH,
    MAX_GRAD_NORM,
    ON_POLICY,
    OffPolicy,
    OnPolicy,
    arguments,
    is_continuous,
    print_answer,
    vf_coef,
)
from sb3_belief.zoo.config import load_config
from sb3_belief.zoo.train import TrainOptions, make_env, make_team

ENV = "mpe/simple_spread_v3"


def settings_of(algorithm: str, steps: int) -> dict[str, Any]:
    """Return what overrides our YAML: the settings that both libraries have."""
    found: dict[str, Any] = {"gamma": GAMMA, "max_grad_norm": MAX_GRAD_NORM, "n_timesteps": steps}
    if algorithm in ON_POLICY:
        on = OnPolicy()
        # Minibatches are counted in joint steps, of which a model for all three agents has three rows
        rows = on.batch_size * (3 if algorithm == "ippo_shared" else 1)
        found |= {"n_envs": on.n_envs, "n_steps": on.n_steps, "n_epochs": on.n_epochs, "batch_size": rows}
        found |= {"learning_rate": on.lr, "gae_lambda": on.gae_lambda, "clip_range": on.clip, "ent_coef": on.ent_coef}
        return {**found, "vf_coef": vf_coef(algorithm)}
    off = OffPolicy()
    found |= {"n_envs": off.n_envs, "learning_rate": off.lr, "gradient_steps": off.updates}
    if algorithm == "qmix":
        # Its replay and its batches are of whole episodes
        found |= {"buffer_size": steps // LENGTH, "batch_size": off.batch_size // LENGTH, "exploration_steps": steps // 2}
        return {**found, "exploration_final_eps": off.final_eps, "policy_kwargs": {"recurrent": False}}
    found |= {"buffer_size": steps, "batch_size": off.batch_size, "learning_starts": off.batch_size}
    return {**found, "train_freq": LENGTH}


def main() -> None:
    """Train, play, and print the returns."""
    args = arguments(__doc__)
    th.set_num_threads(1)
    kwargs = ["continuous_actions:true"] if is_continuous(args.algorithm) else []
    given = ("benchmarks.strength", settings_of(args.algorithm, args.steps))
    config = load_config(args.algorithm, ENV, env_kwargs=kwargs, overrides=[given])
    # Typed as Any, since SB3 takes a team for a model
    team: Any = make_team(config, TrainOptions(verbose=0), make_env(config, config.n_envs, args.seed), args.seed)
    team.learn(args.steps)
    env: Any = make_env(config, 8, 1_000_000 + args.seed, evaluation=True)
    returns: Any = evaluate_policy(team, env, args.episodes, return_episode_rewards=True)[0]
    print_answer([float(each) for each in returns])


if __name__ == "__main__":
    main()
