"""
The ranges of numbers in a configuration that Stable-Baselines3 checks late, or not at all.

A learning rate that is not a number, or no epoch at all, ends a run in its first update, or lets it learn nothing for hours.
"""

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from stable_baselines3.common.utils import LinearSchedule

from sb3_belief.zoo.errors import ConfigError


@dataclass(frozen=True)
class Limits:
    """
    Range of a number.

    :param low: Least number
    :param high: Greatest number
    :param open: Whether the least number itself is excluded
    """

    low: float
    high: float = math.inf
    open: bool = False

    def allow(self, value: float) -> bool:
        """
        Return whether a number lies in the range.

        :param value: The number
        """
        return (value > self.low if self.open else value >= self.low) and value <= self.high

    def __str__(self) -> str:
        if self.high < math.inf:
            return f"in {'(' if self.open else '['}{self.low:g}, {self.high:g}]"
        return f"greater than {self.low:g}" if self.open else f"at least {self.low:g}"


_COUNT, _NOT_NEGATIVE, _POSITIVE, _FRACTION = Limits(1), Limits(0), Limits(0, open=True), Limits(0, 1)

_NAMES: Mapping[Limits, str] = {
    _COUNT: "n_envs n_timesteps n_steps n_epochs batch_size buffer_size stats_window_size train_freq target_update_interval"
    " policy_delay exploration_steps cg_max_steps line_search_max_iter n_critic_updates sub_sampling_factor n_quantiles"
    " n_critics lstm_hidden_size n_lstm_layers net_arch embedding_dim latent_dim features_dim cnn_output_dim"
    " save_freq eval_freq check_freq log_freq n_eval_episodes max_episodes",
    _NOT_NEGATIVE: "learning_rate learning_starts vf_coef target_policy_noise target_noise_clip cg_damping action_coef kl_coef"
    " top_quantiles_to_drop_per_net min_evals max_no_improvement_evals",
    _POSITIVE: "clip_range clip_range_vf max_grad_norm target_kl rms_prop_eps epsilon clip_obs clip_reward",
    _FRACTION: "gamma gae_lambda tau exploration_fraction exploration_initial_eps exploration_final_eps"
    " line_search_shrinking_factor",
    # -1 stands for as many as there were steps, or for never
    Limits(-1): "gradient_steps sde_sample_freq",
}
#: The arguments of algorithms, policies, VecNormalize and callbacks by name. The same name means the same in all of them
LIMITS: Mapping[str, Limits] = {name: limits for limits, names in _NAMES.items() for name in names.split()}


def check_limits(settings: Mapping[str, Any], where: str) -> None:
    """
    Check that all numbers of some settings are finite and in their ranges.

    :param settings: Settings that have been checked against their types
    :param where: Where they are given
    :raises ConfigError: For a number that is not finite or out of its range
    """
    for path, number in _numbers(settings):
        names = [name for name in path if isinstance(name, str)]
        place = ": ".join([where, *names])
        if not _is_finite(number):
            raise ConfigError(f"{place}: must be a finite number, not {number!r}.")
        # The widths of a network may lie in a mapping {pi: [...], vf: [...]}
        name = "net_arch" if "net_arch" in names else names[-1]
        if name in LIMITS and not LIMITS[name].allow(number):
            raise ConfigError(f"{place}: must be {LIMITS[name]}, not {number!r}.")


def _numbers(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], float]]:
    if isinstance(value, bool):
        return
    if isinstance(value, LinearSchedule):
        yield path, value.start
    elif isinstance(value, int | float):
        yield path, value
    elif isinstance(value, str):
        # SAC's entropy coefficient, whose first value stands in a string
        match = re.fullmatch(r"auto_(\S+)", value)
        if match is not None and re.fullmatch(r"[-+]?(nan|inf|infinity)", match[1], re.IGNORECASE):
            yield path, float(match[1])
    elif isinstance(value, Mapping):
        for key, item in value.items():
            yield from _numbers(item, (*path, key))
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            yield from _numbers(item, (*path, index))


def _is_finite(number: float) -> bool:
    try:
        return math.isfinite(number)
    except OverflowError:
        # An integer beyond the range of float
        return False
