"""Evaluations whose episodes follow from the run's seed and the step, so that a continued run evaluates on the same ones."""

from typing import Any

from sb3_contrib.common.maskable.callbacks import MaskableEvalCallback
from stable_baselines3.common.callbacks import EvalCallback

from sb3_belief.common.continued_files import sync_file
from sb3_belief.team.agent_models import env_seed


class SeededEvalCallback(EvalCallback):
    """
    SB3's ``EvalCallback`` for a team, with the environment seeded before each evaluation.

    :param args: Arguments of ``EvalCallback``
    :param seed: Seed of the run
    :param kwargs: Further arguments of ``EvalCallback``
    """

    def __init__(self, *args: Any, seed: int, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.seed = seed
        #: Whether the environment reports successes, as far as is known
        self.reports_success = False

    def _on_step(self) -> bool:
        if not (self.eval_freq > 0 and self.n_calls % self.eval_freq == 0):
            return super()._on_step()
        self.eval_env.seed(env_seed(self.seed, purpose=1, step=self.num_timesteps))
        env: Any = self.eval_env.unwrapped
        env.reports_success = env.reports_success or self.reports_success
        continues = super()._on_step()
        self.reports_success = env.reports_success
        if self.log_path is not None:
            sync_file(f"{self.log_path}.npz")
        return continues


class MaskableSeededEvalCallback(SeededEvalCallback, MaskableEvalCallback):
    """sb3-contrib's ``MaskableEvalCallback`` for a team, with the environment seeded before each evaluation."""
