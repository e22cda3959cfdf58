"""
RLlib's PPO (new API stack), run by ``benchmarks.peers`` in an environment of its own.

This is the fastest way of RLlib within one process: the local env runner steps all copies in one vector and the local learner
updates, without remote env runners and learners. There is one policy per agent, no observation filter, no KL penalty and no
evaluation. Ray starts its services all the same, and their CPU time counts.

What differs: RLlib adds a row for the value at the end of each episode, so that 10 epochs over a rollout of 1,024 rows are 42
minibatches of 256 and not 40 (there is no setting against it). It evaluates the value network only before the update, for all
rows at once. Before its first rollout it steps each copy once, as a check.
"""

import os

# Before ray is imported: no usage reports, and no deduplicated log lines among the errors
os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0", "RAY_DEDUP_LOGS": "0"}

import ray
from mpe2 import simple_spread_v3
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
from ray.tune.registry import register_env

from benchmarks.peers.child import Turns, Workload, workload


def config(work: Workload) -> PPOConfig:
    """Return RLlib's settings for the workload."""
    agents = simple_spread_v3.parallel_env().possible_agents
    return (
        PPOConfig()
        .environment("simple_spread")
        .env_runners(num_env_runners=0, num_envs_per_env_runner=work.n_envs, rollout_fragment_length=work.n_steps)
        .learners(num_learners=0)
        .multi_agent(policies=set(agents), policy_mapping_fn=lambda agent, *_, **__: agent)
        .rl_module(
            model_config=DefaultModelConfig(
                fcnet_hiddens=list(work.hidden), fcnet_activation="tanh", head_fcnet_hiddens=[], vf_share_layers=False
            )
        )
        .training(
            train_batch_size_per_learner=work.rows,
            minibatch_size=work.batch_size,
            num_epochs=work.n_epochs,
            lr=work.lr,
            gamma=work.gamma,
            lambda_=work.gae_lambda,
            clip_param=work.clip,
            vf_loss_coeff=work.vf_coef,
            grad_clip=work.max_grad_norm,
            grad_clip_by="global_norm",
            use_kl_loss=False,
        )
        .reporting(min_sample_timesteps_per_iteration=0, min_time_s_per_iteration=0)
    )


def main() -> None:
    """Train until there are no more requests."""
    work, _ = workload()
    turns = Turns("ray")
    ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False, configure_logging=False)
    register_env("simple_spread", lambda _: ParallelPettingZooEnv(simple_spread_v3.parallel_env()))
    algorithm = config(work).build_algo()
    while True:
        algorithm.train()
        turns.end(work.rows)


if __name__ == "__main__":
    main()
