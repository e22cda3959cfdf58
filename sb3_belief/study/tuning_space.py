"""The space in which hyper-parameters are searched, as YAML describes it and as Optuna samples it."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from sb3_belief.zoo.errors import ConfigError, short, unknown_setting

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

_FORMS = "{low: 1e-4, high: 1e-2, log: true} or {choices: [...]}"
_RANGE_KEYS = ("low", "high", "log", "step", "schedule")
# Settings that are the same in all trials: only runs of equal length can be compared, and pruned at equal moments
_FIXED = {"n_timesteps": "all trials train for the same number of joint steps, which n_timesteps beside search says"}


@dataclass(frozen=True)
class SearchRange:
    """
    Numbers from one to another.

    :param low: Least number
    :param high: Greatest number
    :param log: Whether the logarithms are drawn evenly
    :param step: Distance of neighbouring numbers, None for any number between (any integer, if both ends are integers)
    :param schedule: ``"linear"`` for a schedule that falls linearly from the number to 0; None for the number itself
    """

    low: int | float
    high: int | float
    log: bool = False
    step: int | float | None = None
    schedule: str | None = None

    def distribution(self) -> "BaseDistribution":
        """Return what Optuna draws from."""
        from optuna.distributions import FloatDistribution, IntDistribution

        if isinstance(self.low, int) and isinstance(self.high, int):
            return IntDistribution(self.low, self.high, log=self.log, step=1 if self.step is None else int(self.step))
        return FloatDistribution(float(self.low), float(self.high), log=self.log, step=self.step)

    def setting(self, drawn: Any) -> Any:
        """
        Return the setting that was drawn.

        :param drawn: What Optuna drew
        :return: The number, or the name of the schedule that begins with it
        """
        return drawn if self.schedule is None else f"lin_{drawn!r}"

    def extremes(self) -> list[Any]:
        """Return the settings that a check has to try: if both ends are allowed, what lies between is."""
        return [self.setting(self.low), self.setting(self.high)]


@dataclass(frozen=True)
class SearchChoices:
    """
    A few settings of any kind.

    :param choices: The settings, as plain data
    """

    choices: tuple[Any, ...]

    def distribution(self) -> "BaseDistribution":
        """Return what Optuna draws from. What is no scalar is drawn as its text, which its storage can hold."""
        from optuna.distributions import CategoricalDistribution

        return CategoricalDistribution([json.dumps(each) for each in self.choices] if self._as_text else list(self.choices))

    def setting(self, drawn: Any) -> Any:
        """
        Return the setting that was drawn.

        :param drawn: What Optuna drew
        :return: The setting
        """
        return json.loads(drawn) if self._as_text else drawn

    def extremes(self) -> list[Any]:
        """Return the settings that a check has to try."""
        return list(self.choices)

    @property
    def _as_text(self) -> bool:
        return not all(isinstance(each, bool | int | float | str) or each is None for each in self.choices)


SearchSpace = dict[str, SearchRange | SearchChoices]


def parse_space(data: Any, where: str) -> SearchSpace:
    """
    Read a search space.

    :param data: Mapping of settings to ranges or choices, as the YAML gives it; a dot in a key stands for a nested setting
    :param where: File and key, for the error message
    :return: The space, by the dotted names of the settings
    :raises ConfigError: For anything else
    """
    if not isinstance(data, Mapping) or not data:
        raise ConfigError(
            f"{where}: must map settings to what is searched, such as learning_rate: {_FORMS}, not {short(data)}."
        )
    space: SearchSpace = {}
    for name, entry in data.items():
        here = f"{where}: {name}"
        if name in _FIXED:
            raise ConfigError(f"{here}: cannot be searched: {_FIXED[name]}.")
        if not all(name.split(".")):
            raise ConfigError(f"{here}: is no name of a setting; a nested one is written as policy_kwargs.net_arch.")
        if not isinstance(entry, Mapping):
            raise ConfigError(f"{here}: must be {_FORMS}, not {short(entry)}; what is not searched belongs in params.")
        if "choices" in entry:
            space[name] = _choices(entry, here)
        else:
            space[name] = _range(entry, here)
    for name in space:
        inner = [other for other in space if other.startswith(f"{name}.")]
        if inner:
            raise ConfigError(f"{where}: {name!r} and {inner[0]!r} are both searched, and one contains the other: keep one.")
    return space


def _choices(entry: Mapping[str, Any], where: str) -> SearchChoices:
    further = [key for key in entry if key != "choices"]
    if further:
        raise unknown_setting(where, "key beside choices", further[0], ())
    choices = entry["choices"]
    if not isinstance(choices, list) or len(choices) < 2:
        raise ConfigError(f"{where}: choices: must be a list of at least two settings, not {short(choices)}.")
    try:
        texts = [json.dumps(each) for each in choices]
    except TypeError:
        raise ConfigError(f"{where}: choices: must be numbers, texts, lists and mappings, not {short(choices)}.") from None
    doubled = [text for text in texts if texts.count(text) > 1]
    if doubled:
        raise ConfigError(f"{where}: choices: {doubled[0]} is there twice: name each once.")
    return SearchChoices(tuple(choices))


def _range(entry: Mapping[str, Any], where: str) -> SearchRange:
    for key in entry:
        if key not in _RANGE_KEYS:
            raise unknown_setting(where, "key", key, (*_RANGE_KEYS, "choices"))
    for key in ("low", "high"):
        if key not in entry:
            raise ConfigError(f"{where}: has no {key!r}: give low and high, or choices: [...].")
        if not _is_number(entry[key]):
            raise ConfigError(f"{where}: {key}: must be a finite number, not {short(entry[key])}.")
    low, high, log, step = entry["low"], entry["high"], entry.get("log", False), entry.get("step")
    if isinstance(low, int) != isinstance(high, int):
        # One of them was written without a point, and integers are meant only where both are
        low, high = float(low), float(high)
    if not low < high:
        raise ConfigError(f"{where}: low must be less than high, not {low!r} and {high!r}.")
    if not isinstance(log, bool):
        raise ConfigError(f"{where}: log: must be true or false, not {short(log)}.")
    if log and low <= 0:
        raise ConfigError(f"{where}: with log: true low must be greater than 0, not {low!r}.")
    if step is not None:
        if not _is_number(step) or step <= 0 or (isinstance(low, int) and not isinstance(step, int)):
            kind = "an integer" if isinstance(low, int) else "a number"
            raise ConfigError(f"{where}: step: must be {kind} greater than 0, not {short(step)}.")
        if log:
            raise ConfigError(f"{where}: step and log: true exclude each other: leave one out.")
    schedule = entry.get("schedule")
    if schedule not in (None, "linear"):
        raise ConfigError(
            f"{where}: schedule: must be linear (from the drawn number to 0) or left out, not {short(schedule)}."
        )
    return SearchRange(low, high, log, step, schedule)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
