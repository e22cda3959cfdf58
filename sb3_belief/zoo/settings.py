"""The settings that a configuration may have, and the check of one source of them."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from stable_baselines3.common.callbacks import (
    BaseCallback,
    StopTrainingOnNoModelImprovement,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from sb3_belief.zoo.checks import Location, accepted_arguments, check_call, check_paths, check_run_file, check_value
from sb3_belief.zoo.errors import ConfigError, unknown_setting
from sb3_belief.zoo.limits import check_limits
from sb3_belief.zoo.names import Algo, resolve
from sb3_belief.zoo.partners import check_partners

#: The settings of the run itself. Every other key is an argument of the algorithm's constructor
RUN_KEYS: dict[str, Any] = {
    "n_envs": int,
    "n_timesteps": int,
    "policy": str,
    "policy_kwargs": dict[str, Any],
    "normalize": bool | dict[str, Any],
    "env_wrapper": str | list[Any] | dict[str, Any] | None,
    "visibility": str | dict[str, Any] | None,
    "observe_last": bool | list[str],
    "memory_span": str,
    "env_kwargs": dict[str, Any],
    "eval_env_kwargs": dict[str, Any],
    "callback": str | list[Any] | dict[str, Any] | None,
    "agent_kwargs": dict[str, dict[str, Any]],
    "partners": dict[str, Any] | None,
    "adapter_kwargs": dict[str, Any],
}
# The settings that agent_kwargs may give a single agent, besides the arguments of its algorithm
_AGENT_KEYS = {"algo": str, "policy": str, "policy_kwargs": dict[str, Any]}

#: How long a recurrent agent remembers: sb3-contrib's own to the end of an episode
MEMORY_SPANS = ("episode", "partner")

_FLAGS = {
    "algo": "use the flag --algo, or for single agents agent_kwargs: {<agent>: {algo: <name>}}",
    "env": "use the flag --env",
    "seed": "use the flag --seed",
    "device": "use the flag --device",
    "verbose": "use the flag --verbose",
    "tensorboard_log": "use the flag --tensorboard-log",
    "_init_setup_model": "it is internal to Stable-Baselines3",
}
_POLICY_INTERNAL = dict.fromkeys(
    ("observation_space", "action_space", "lr_schedule", "others_action_spaces"), "the algorithm sets it"
)


class SettingsChecker:
    """
    Checker of one source of settings at a time, for a given algorithm and environment.

    :param algo: The algorithm
    :param make_env: Callable that makes the environment
    :param n_leading: Number of its leading arguments that the environment's id determines
    :param policy: Name of the policy after merging. ``policy_kwargs`` are checked against its arguments
    :param agents: Checkers of the settings of single agents, by agent
    """

    def __init__(
        self,
        algo: Algo,
        make_env: Callable[..., Any],
        n_leading: int,
        policy: Any,
        agents: Mapping[str, "SettingsChecker"] | None = None,
    ) -> None:
        self.algo_class, self.adapter = algo.load(), algo.load_adapter()
        self.make_env, self.n_leading, self.agents = make_env, n_leading, agents or {}
        self.policies = self.algo_class.policy_aliases
        self.policy_class = self.policies.get(policy) if isinstance(policy, str) else None
        arguments, _ = accepted_arguments(self.algo_class)
        fixed = {name: f"the algorithm's name stands for {name}={value!r}" for name, value in algo.fixed.items()}
        self.reserved = {**_FLAGS, **fixed}
        self.arguments = {name: hint for name, hint in arguments.items() if name not in (*RUN_KEYS, *self.reserved)}
        # The algorithm passes some of its arguments to its policy. They can only be set as the algorithm's
        self.policy_reserved = {**_POLICY_INTERNAL, **dict.fromkeys(arguments, "set it beside policy_kwargs, not inside")}

    def check(self, layer: dict[str, Any], location: Location) -> dict[str, Any]:
        """
        Check one source of settings.

        :param layer: Settings as plain data
        :param location: Where they are given
        :return: The settings with wrappers, callbacks, classes and schedules in place of their names
        :raises ConfigError: For a setting that does not fit
        """
        checked = {}
        allowed = [*RUN_KEYS, *self.arguments]
        for key, value in layer.items():
            if key in self.reserved:
                why = f"{key!r} cannot be set here: {self.reserved[key]}"
                raise ConfigError(f"{location.text}: {why}. Allowed: {', '.join(allowed)}.")
            if key in RUN_KEYS:
                checked[key] = self._check_run_key(key, value, location.key(key))
            elif key in self.arguments:
                checked[key] = check_value(value, self.arguments[key], location.key(key))
                check_limits({key: checked[key]}, location.text)
            elif self.policy_class is not None and key in accepted_arguments(self.policy_class)[0]:
                raise ConfigError(f"{location.text}: {key!r} is a setting of the policy: write policy_kwargs: {{{key}: ...}}.")
            else:
                raise unknown_setting(location.text, "key", key, allowed)
        return checked

    def _check_agent(self, settings: dict[str, Any], location: Location) -> dict[str, Any]:
        """Check the settings of a single agent in ``agent_kwargs``; this is the checker of its own algorithm."""
        foreign = [key for key in settings if key in RUN_KEYS and key not in _AGENT_KEYS]
        if foreign:
            raise ConfigError(
                f"{location.text}: {foreign[0]!r} is the same for all agents: set it outside of agent_kwargs. Allowed:"
                f" {', '.join([*_AGENT_KEYS, *self.arguments])}."
            )
        checked = self.check({key: value for key, value in settings.items() if key != "algo"}, location)
        return {**({"algo": settings["algo"]} if "algo" in settings else {}), **checked}

    def _check_run_key(self, key: str, value: Any, location: Location) -> Any:
        value = check_value(value, RUN_KEYS[key], location)
        if key in ("n_envs", "n_timesteps", "policy_kwargs", "normalize"):
            check_limits({key: value}, location.parent)
        if key in ("partners", "adapter_kwargs"):
            return check_partners(value, location) if key == "partners" else self._check_adapter_kwargs(value, location)
        if key == "agent_kwargs":
            return {agent: self.agents[agent]._check_agent(own, location.key(agent)) for agent, own in value.items()}
        if key == "memory_span" and value not in MEMORY_SPANS:
            raise unknown_setting(location.text, "memory span", value, MEMORY_SPANS)
        if key == "policy" and value not in self.policies:
            raise unknown_setting(location.text, "policy", value, self.policies)
        if key == "policy_kwargs" and self.policy_class is not None:
            return self._check_policy_kwargs(self.policy_class, value, location)
        if key == "normalize" and isinstance(value, dict):
            return check_call(VecNormalize, value, location, skip=1)
        if key in ("env_kwargs", "eval_env_kwargs"):
            check_paths(value, location)
            return check_call(self.make_env, value, location, skip=self.n_leading, of_env=True)
        if key == "env_wrapper":
            return tuple(self._check_calls(value, location, skip=1))
        if key == "visibility":
            calls = self._check_calls(value, location, skip=1)
            if len(calls) > 1:
                raise ConfigError(f"{location.text}: must name one function, not {len(calls)}: there is one visibility.")
            return partial(calls[0][0], **calls[0][1]) if calls else None
        if key == "callback":
            callbacks = tuple(self._check_calls(value, location, check=_check_callback))
            for callback, kwargs in callbacks:
                check_limits(kwargs, location.key(callback.__name__).text)
            return callbacks
        return value

    def _check_adapter_kwargs(self, value: Any, location: Location) -> dict[str, Any]:
        if self.adapter is None:
            raise ConfigError(f"{location.text}: agents of this algorithm learn from what they see themselves: leave it out.")
        return check_call(self.adapter, value, location, skip=1)

    def _check_policy_kwargs(self, policy_class: type, value: Any, location: Location) -> dict[str, Any]:
        checked = check_call(policy_class, value, location, reserved=self.policy_reserved)
        networks = checked.get("net_arch")
        # SB3 makes no network of a name that it does not know, and says nothing
        names = ("pi", "vf" if issubclass(self.algo_class, OnPolicyAlgorithm) else "qf")
        for name in networks if isinstance(networks, dict) else ():
            if name not in names:
                raise unknown_setting(location.key("net_arch").text, "network", name, names)
        return checked

    def _check_calls(
        self, value: Any, location: Location, skip: int = 0, check: Callable[[Any, Location], None] | None = None
    ) -> list[tuple[Callable[..., Any], dict[str, Any]]]:
        """Read what may be a ``path``, a mapping ``{path: arguments, ...}``, or a list of these."""
        calls = []
        for item in value if isinstance(value, list) else [] if value is None else [value]:
            for path, arguments in item.items() if isinstance(item, dict) else [(item, None)]:
                function = resolve(path, location.text, location.extra_packages)
                if check is not None:
                    check(function, location)
                arguments = check_call(function, arguments, location.key(path), skip=skip, complete=True)
                check_run_file(function, arguments, location.key(path))
                calls.append((function, arguments))
        return calls


def observation_arguments(settings: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return what settings say of what agents observe besides.

    :param settings: Those of a run
    :return: Arguments of ``make_team_env``; none where the settings say nothing, so that the environment is what it is
    """
    observe_last = settings.get("observe_last", False)
    # Names in observe_last are those of the agents that learn: their memories are meant, too
    told = (observe_last or True) if settings.get("memory_span") == "partner" else False
    return {name: value for name, value in (("observe_last", observe_last), ("partner_starts", told)) if value}


def _check_callback(callback: Any, location: Location) -> None:
    if not (isinstance(callback, type) and issubclass(callback, BaseCallback)):
        raise ConfigError(f"{location.text}: {callback.__name__} is not a callback of Stable-Baselines3.")
    if "eval_env" in accepted_arguments(callback)[0]:
        raise ConfigError(
            f"{location.text}: {callback.__name__} needs an environment, which YAML cannot hold: the team is evaluated every"
            " --eval-freq joint steps (--eval-episodes, --n-eval-envs and --eval-env-kwargs say how)."
        )
    if issubclass(callback, StopTrainingOnRewardThreshold | StopTrainingOnNoModelImprovement):
        raise ConfigError(
            f"{location.text}: {callback.__name__} works only inside an EvalCallback, to which YAML cannot pass it: train from"
            " Python, with EvalCallback(env, callback_after_eval=...)."
        )
