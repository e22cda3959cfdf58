"""
BenchMARL's IPPO over TorchRL, run by ``benchmarks.peers`` in an environment of its own.

The copies are stepped in this process (``SerialEnv``, its default), without logger, evaluation, rendering and checkpoints. The
agents are one group in which each has networks of its own. This is faster than a group for each agent, since the networks of
all three are evaluated and updated at once.

What differs: there is one Adam for the policies and one for the value networks of all three, with gradients clipped for each
of the two but not for each agent; a minibatch has the same 256 steps for all agents; advantages are not normalised.
"""

import tempfile
from collections.abc import Callable
from typing import Any

import torch
from benchmarl.algorithms import IppoConfig
from benchmarl.environments.pettingzoo.common import PettingZooClass
from benchmarl.experiment import Callback, Experiment, ExperimentConfig
from benchmarl.models import MlpConfig
from mpe2 import simple_spread_v3
from torchrl.envs import EnvBase, PettingZooWrapper

from benchmarks.peers.child import Turns, workload


class Spread(PettingZooClass):
    """The task, since BenchMARL's own one imports a module that PettingZoo no longer has. The environment is the same."""

    def get_env_fun(self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any) -> Callable[[], EnvBase]:
        return lambda: PettingZooWrapper(
            simple_spread_v3.parallel_env(),
            categorical_actions=True,
            seed=seed,
            device=device,
        )

    def has_state(self) -> bool:
        return False


class Ends(Callback):
    """
    Callback that answers after each update, which ends with that of the last group.

    :param turns: Sends the answer
    :param steps: Joint steps of an iteration
    """

    def __init__(self, turns: Turns, steps: int) -> None:
        super().__init__()
        self.turns, self.steps = turns, steps

    def __getstate__(self) -> dict[str, Any]:
        # BenchMARL pickles its callbacks
        return {}

    def on_train_end(self, training_td: Any, group: str) -> None:
        if group == list(self.experiment.group_map)[-1]:
            self.turns.end(self.steps)


def main() -> None:
    """Train until there are no more requests."""
    work, _ = workload()
    turns = Turns("benchmarl", "torchrl")
    config = ExperimentConfig.get_from_yaml()
    config.share_policy_params = False
    config.prefer_continuous_actions = False
    config.gamma, config.lr, config.clip_grad_val = work.gamma, work.lr, work.max_grad_norm
    config.max_n_frames = 10**9
    config.on_policy_collected_frames_per_batch = work.rows
    config.on_policy_n_envs_per_worker = work.n_envs
    config.on_policy_n_minibatch_iters = work.n_epochs
    config.on_policy_minibatch_size = work.batch_size
    config.loggers, config.create_json, config.evaluation, config.render = [], False, False, False
    algorithm = IppoConfig.get_from_yaml()
    algorithm.share_param_critic = False
    algorithm.lmbda, algorithm.clip_epsilon, algorithm.critic_coef = work.gae_lambda, work.clip, work.vf_coef
    model = MlpConfig.get_from_yaml()
    model.num_cells, model.activation_class = list(work.hidden), torch.nn.Tanh
    with tempfile.TemporaryDirectory() as folder:
        config.save_folder = folder
        Experiment(
            task=Spread("SIMPLE_SPREAD", {"max_cycles": 25}),
            algorithm_config=algorithm,
            model_config=model,
            seed=0,
            config=config,
            callbacks=[Ends(turns, work.rows)],
        ).run()


if __name__ == "__main__":
    main()
