"""Evaluations whose episodes follow from the run's seed and the step, so that a continued run evaluates on the same ones."""

from typing import Any

from sb3_contrib.common.maskable.callbacks import MaskableEvalCallback
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.utils import safe_mean

from sb3_belief.common.continued_files import sync_file
from sb3_belief.team.agent_models import env_seed
from sb3_belief.team.logs import MOST_PARTNERS


class SeededEvalCallback(EvalCallback):
    """
    SB3's ``EvalCallback`` for a team, with the environment seeded before each evaluation.

    Where the environment names partners, the mean return beside each is logged as ``eval/partners/<name>/mean_reward``, for at
    most the first 20 that are met.

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
        self._returns: dict[str, list[float]] = {}
        continues = super()._on_step()
        self.reports_success = env.reports_success
        if self.log_path is not None:
            sync_file(f"{self.log_path}.npz")
        return continues

    def _log_success_callback(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        super()._log_success_callback(locals_, globals_)
        info = locals_["info"]
        name = info.get("partner")
        if "episode" in info and isinstance(name, str) and (name in self._returns or len(self._returns) < MOST_PARTNERS):
            self._returns.setdefault(name, []).append(info["episode"]["r"])
            # SB3 writes the table within its own step, so each episode's record replaces the one before
            self.logger.record(f"eval/partners/{name}/mean_reward", safe_mean(self._returns[name]))


class MaskableSeededEvalCallback(SeededEvalCallback, MaskableEvalCallback):
    """sb3-contrib's ``MaskableEvalCallback`` for a team, with the environment seeded before each evaluation."""
