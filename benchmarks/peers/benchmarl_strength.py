"""
What BenchMARL's agents have learned of simple_spread after so many steps, run by ``benchmarks.strength``.

    python -m benchmarks.peers.benchmarl_strength ippo --seed 0 --steps 100000

The settings are those of ``spread_settings``, and BenchMARL's own in all else. The last line of the output is JSON: the
returns of the greedy episodes, each the mean of the three agents', and CPU seconds.
"""

import tempfile
from collections.abc import Callable
from typing import Any

import torch
from benchmarl.algorithms import IppoConfig, MaddpgConfig, MappoConfig, QmixConfig
from benchmarl.algorithms.common import AlgorithmConfig
from benchmarl.experiment import Experiment, ExperimentConfig
from benchmarl.models import MlpConfig
from mpe2 import simple_spread_v3
from torchrl.envs import EnvBase, PettingZooWrapper
from torchrl.envs.utils import ExplorationType, set_exploration_type

from benchmarks.peers.benchmarl import Spread
from benchmarks.peers.spread_settings import (
    GAMMA,
    HIDDEN,
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

CONFIGS = {"ippo": IppoConfig, "ippo_shared": IppoConfig, "mappo": MappoConfig, "qmix": QmixConfig, "maddpg": MaddpgConfig}


class Moved(Spread):
    """The task with velocities as actions."""

    def get_env_fun(self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any) -> Callable[[], EnvBase]:
        return lambda: PettingZooWrapper(simple_spread_v3.parallel_env(continuous_actions=True), seed=seed, device=device)

    def supports_continuous_actions(self) -> bool:
        return True

    def supports_discrete_actions(self) -> bool:
        return False


def algorithm_of(name: str) -> AlgorithmConfig:
    """Return the configuration of an algorithm."""
    algorithm = CONFIGS[name].get_from_yaml()
    if name in ON_POLICY:
        work = OnPolicy()
        algorithm.share_param_critic = name == "ippo_shared"
        algorithm.lmbda, algorithm.clip_epsilon, algorithm.entropy_coef = work.gae_lambda, work.clip, work.ent_coef
        algorithm.critic_coef = vf_coef(name)
    return algorithm


def experiment_of(name: str, steps: int) -> ExperimentConfig:
    """Return the settings of the training."""
    config = ExperimentConfig.get_from_yaml()
    # QMIX shares weights here, as it does in ours
    config.share_policy_params = name in ("ippo_shared", "qmix")
    config.prefer_continuous_actions = is_continuous(name)
    config.max_n_frames, config.gamma, config.clip_grad_val = steps, GAMMA, MAX_GRAD_NORM
    on, off = OnPolicy(), OffPolicy()
    config.on_policy_collected_frames_per_batch, config.on_policy_n_envs_per_worker = on.n_envs * on.n_steps, on.n_envs
    config.on_policy_n_minibatch_iters, config.on_policy_minibatch_size = on.n_epochs, on.batch_size
    config.off_policy_collected_frames_per_batch, config.off_policy_n_envs_per_worker = off.rows, off.n_envs
    config.off_policy_n_optimizer_steps, config.off_policy_train_batch_size = off.updates, off.batch_size
    config.off_policy_memory_size = steps
    config.exploration_eps_init, config.exploration_eps_end = 1.0, off.final_eps
    config.exploration_anneal_frames = steps // 2
    config.lr = on.lr if name in ON_POLICY else off.lr
    config.loggers, config.create_json, config.evaluation, config.render = [], False, False, False
    return config


def returns_of(experiment: Experiment, episodes: int, seed: int) -> list[float]:
    """Play greedy episodes, and return the mean of the agents' returns in each."""
    found = []
    env = experiment.task.get_env_fun(1, False, seed, "cpu")()
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(episodes):
            played = env.rollout(LENGTH, policy=experiment.policy)
            found.append(float(played["next", "agent", "reward"].sum(0).mean()))
    return found


def main() -> None:
    """Train, play, and print the returns."""
    args = arguments(__doc__)
    torch.set_num_threads(1)
    model = MlpConfig.get_from_yaml()
    model.num_cells, model.activation_class = list(HIDDEN), torch.nn.Tanh
    with tempfile.TemporaryDirectory() as folder:
        config = experiment_of(args.algorithm, args.steps)
        config.save_folder = folder
        experiment = Experiment(
            task=(Moved if is_continuous(args.algorithm) else Spread)("SIMPLE_SPREAD", {"max_cycles": LENGTH}),
            algorithm_config=algorithm_of(args.algorithm),
            model_config=model,
            seed=args.seed,
            config=config,
        )
        experiment.run()
        returns = returns_of(experiment, args.episodes, 1_000_000 + args.seed)
    print_answer(returns)


if __name__ == "__main__":
    main()
