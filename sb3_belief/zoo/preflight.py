"""What is tried before a run writes anything: its folders, its device, and whether its sizes can be."""

import inspect
import itertools
import math
import os
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from inspect import signature
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.utils import get_device

from sb3_belief.common.action_masks import sample_action
from sb3_belief.envs.registry import spec
from sb3_belief.team import TeamVecEnv
from sb3_belief.zoo.config import AgentConfig, RunConfig
from sb3_belief.zoo.errors import ConfigError, cause, reason_of, short, shorten

_GB = 1e9
# Least memory of a copy of an environment, in bytes: the objects of one in this process, and a Python with numpy in a worker
_COPY, _WORKER = 2_000, 30_000_000


def check_folder(folder: str | os.PathLike[str], flag: str) -> None:
    """
    Check that files can be written in a folder, which is made if necessary and removed again.

    :param folder: Path of the folder
    :param flag: Flag that it was given to, for the error message
    :raises ConfigError: If it cannot be made, or not written
    """
    try:
        # Only an attempt tells: permissions are not all that can prevent a file (a full disk, a read-only mount, /proc)
        with _made(Path(folder)), tempfile.TemporaryFile(dir=folder):
            pass
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"{flag}: cannot write in the folder {short(str(folder))} ({reason_of(error)}): name one that can be written."
        ) from None


def check_output(path: str, flag: str) -> None:
    """
    Check that a file can be written.

    :param path: Path of the file, whose folder need not exist yet
    :param flag: Flag that it was given to, for the error message
    :raises ConfigError: If it cannot
    """
    file = Path(path)
    try:
        with _made(file.parent):
            existed = os.path.exists(path)
            # For adding: a file that exists keeps its contents
            with open(path, "ab"):
                pass
            if not existed:
                file.unlink()
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"{flag}: cannot write the file {short(path)} ({reason_of(error)}): name one that can be written."
        ) from None


@contextmanager
def _made(folder: Path) -> Iterator[None]:
    """Make a folder for the lines in the context, with those above it that are missing, and remove what was made."""
    made: list[Path] = []
    try:
        for each in reversed([folder, *folder.parents]):
            if not each.is_dir():
                each.mkdir()
                made.append(each)
        yield
    finally:
        for each in reversed(made):
            each.rmdir()


def check_device(device: str) -> None:
    """
    Check that models can be on a device.

    :param device: ``"auto"`` or the name of a device
    :raises ConfigError: If there is no such device here. Stable-Baselines3 would take the CPU instead of a missing GPU
    """
    if device == "auto":
        return
    try:
        th.zeros(1, device=device).sum().item()
    # torch raises whatever the backend raises
    except Exception as error:
        found = [f"cuda:{index}" for index in range(th.cuda.device_count())] if th.cuda.is_available() else []
        text = " ".join(str(error).split())
        reason = "torch knows no such device" if text.startswith(("Expected one of", "Invalid device")) else text[:150]
        raise ConfigError(
            f"--device: {device!r} is not available here ({reason}). Allowed: {', '.join(['auto', 'cpu', *found])}."
        ) from None


def check_copies(n_envs: int, vec_env: str, where: str) -> None:
    """
    Check that so many copies of an environment can be, before the first of them is made.

    :param n_envs: Number of copies
    :param vec_env: ``"dummy"`` or ``"subproc"``
    :param where: Flag, or file and key, for the error message
    :raises ConfigError: If they need more memory than there is
    """
    needed = n_envs * (_WORKER if vec_env == "subproc" else _COPY)
    if needed > total_memory():
        kind = "worker processes" if vec_env == "subproc" else "copies of the environment"
        raise ConfigError(
            f"{where}: {n_envs:,} {kind} need at least {needed / _GB:,.0f} GB of memory, and this machine has"
            f" {total_memory() / _GB:,.0f} GB: use fewer."
        )


def check_memory(config: RunConfig, env: TeamVecEnv) -> None:
    """
    Check that the models of a team can be, before their memory is allocated.

    :param config: Configuration of the team
    :param env: Its environment
    :raises ConfigError: If buffers and networks need more memory than the machine has. The message has the estimate
    """
    observed, acted = cast("spaces.Dict", env.observation_space), cast("spaces.Dict", env.action_space)
    parts = {agent: _agent_memory(config.agent(agent), config, observed[agent], acted[agent]) for agent in env.possible_agents}
    needed = sum(sum(part.values()) for part in parts.values())
    if needed > total_memory():
        agent, largest = max(parts.items(), key=lambda item: sum(item[1].values()))
        name = max(largest, key=lambda key: largest[key])
        raise ConfigError(
            f"{config.origin(name)}: the models need about {needed / _GB:,.0f} GB of memory, and this machine has"
            f" {total_memory() / _GB:,.0f} GB. Lower {name!r}, of which {agent} alone needs {largest[name] / _GB:,.1f} GB."
        )


def warn_of_rollouts(config: RunConfig, agents: Sequence[str]) -> None:
    """
    Warn if an environment that draws others of its own by rollouts counts other rollouts than the agents have.

    :param config: Configuration of the team
    :param agents: Names of the agents
    """
    try:
        parameters = signature(spec(config.env_id).load()).parameters
    # What is written in C may have none
    except (TypeError, ValueError):
        return
    given = {**{name: each.default for name, each in parameters.items()}, **config.env_kwargs}
    steps = given.get("rollout_steps")
    if given.get("redraw_unit") != "rollouts" or not isinstance(steps, int):
        return
    lengths: set[int] = {config.agent(agent).algo_kwargs.get("n_steps", steps) for agent in agents}
    if lengths != {steps}:
        warnings.warn(
            f"{config.env_id} counts rollouts of rollout_steps={steps} steps, but those of the agents have n_steps of"
            f" {', '.join(map(str, sorted(lengths)))}: whom it draws changes within them. To have both alike set"
            f" rollout_steps in env_kwargs (--env-kwargs rollout_steps:{min(lengths)}).",
            stacklevel=2,
        )


def check_optimizers(config: RunConfig, device: str) -> None:
    """
    Check that the optimisers that a configuration names make a step as Stable-Baselines3 calls them.

    :param config: Configuration of the team
    :param device: ``"auto"`` or the name of a device
    :raises ConfigError: If one cannot be made, or fails in its first step
    """
    common = (config.origin("optimizer_class optimizer_kwargs"), config.algo_kwargs)
    own = [
        (f"{config.origins['agent_kwargs']}: agent_kwargs: {name}", each.algo_kwargs) for name, each in config.agents.items()
    ]
    for where, kwargs in (common, *own):
        settings = kwargs.get("policy_kwargs") or {}
        if settings.keys() & {"optimizer_class", "optimizer_kwargs"}:
            try:
                _step_optimizer(settings.get("optimizer_class", th.optim.Adam), settings.get("optimizer_kwargs") or {}, device)
            # torch raises whatever the optimiser raises
            except Exception as error:
                raise ConfigError(
                    f"{where}: policy_kwargs: the optimizer refuses what Stable-Baselines3 does with one: {cause(error)} Use"
                    " another optimizer_class, such as torch.optim.Adam, or other optimizer_kwargs."
                ) from error


def _step_optimizer(optimizer_class: type[th.optim.Optimizer], kwargs: dict[str, Any], device: str) -> None:
    """Make a step with gradients of zero, as for a network of one layer: dense gradients, and no closure."""
    parameters = [th.nn.Parameter(th.zeros(shape, device=get_device(device))) for shape in ((2, 2), (2,))]
    optimizer: Any = optimizer_class(parameters, lr=1e-3, **kwargs)  # type: ignore[call-arg]
    for parameter in parameters:
        parameter.grad = th.zeros_like(parameter)
    optimizer.step()


def check_step(config: RunConfig, env: TeamVecEnv) -> None:
    """
    Check that an environment with wrappers of the configuration can be stepped.

    :param config: Configuration of the team
    :param env: A copy for this alone: a step might change what a reset does not
    :raises ConfigError: If a step with random actions fails
    """
    try:
        env.reset()
        masks, rng = env.action_masks() or {}, np.random.default_rng(0)
        acted = cast("spaces.Dict", env.action_space)
        env.step(
            {
                agent: np.stack([sample_action(acted[agent], masks[agent][0] if agent in masks else None, rng)])
                for agent in env.possible_agents
            }
        )
    except Exception as error:
        raise ConfigError(
            f"{config.origin('env_wrapper')}: env_wrapper: {config.env_id} cannot be stepped with it: {cause(error)}"
        ) from error


def agent_without_masks(config: RunConfig, env: TeamVecEnv) -> str | None:
    """
    Return the first agent whose algorithm needs action masks and that the environment gives none.

    :param config: The configuration
    :param env: The environment, which has been reset
    :return: Its name; None if there is none
    """
    masks = env.action_masks() or {}
    for agent in env.possible_agents:
        algo_class: Any = config.agent(agent).algo_class
        takes_masks = "action_masks" in signature(algo_class.predict).parameters
        if takes_masks and getattr(algo_class, "needs_action_masks", True) and agent not in masks:
            return agent
    return None


def check_eval_env(config: RunConfig, env: TeamVecEnv, eval_env: TeamVecEnv) -> None:
    """
    Check that a team can act in the environment of its evaluations.

    :param config: Configuration of the team
    :param env: Environment in which it learns
    :param eval_env: Environment of its evaluations
    :raises ConfigError: If agents or spaces differ. Bounds of observations may, since no model depends on them
    """
    trained, evaluated = env.possible_agents, eval_env.possible_agents
    differing = f"the agents {trained} learn, and evaluations have {evaluated}" if set(trained) != set(evaluated) else ""
    for agent in [] if differing else trained:
        for kind in ("observation", "action"):
            own, other = (cast("spaces.Dict", getattr(each, f"{kind}_space"))[agent] for each in (env, eval_env))
            if not differing and (own != other if kind == "action" else _form(own) != _form(other)):
                differing = shorten(f"the {kind} space of {agent!r} is {own} in training and {other} in evaluations")
    if differing:
        raise ConfigError(
            f"{config.origin('eval_env_kwargs:')}: eval_env_kwargs: {differing}, in which the team cannot act:"
            " evaluations need the agents and spaces of the training."
        )


def _form(space: spaces.Space) -> Any:
    """Return what a network depends on of an observation space."""
    if isinstance(space, spaces.Dict):
        return {key: _form(part) for key, part in space.items()}
    return (space.shape, space.dtype) if isinstance(space, spaces.Box) else space


def total_memory() -> float:
    """
    Return the machine's memory.

    :return: Bytes; infinite where the system does not say it
    """
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, ValueError, OSError):
        return math.inf


def _agent_memory(agent: AgentConfig, config: RunConfig, observed: spaces.Space, acted: spaces.Space) -> dict[str, float]:
    """Estimate the bytes of an agent's buffers and networks from below, by the setting that decides them."""
    defaults = {name: each.default for name, each in inspect.signature(agent.algo_class).parameters.items()}
    settings: dict[str, Any] = {**defaults, **agent.algo_kwargs}
    network = agent.algo_kwargs.get("policy_kwargs") or {}
    width, action = spaces.flatdim(observed), spaces.flatdim(acted)
    if "buffer_size" in settings:
        # The memory of a replay buffer is taken as it fills
        rows, name = min(settings["buffer_size"], config.n_timesteps), "buffer_size"
        row = 2 * width * (1 if observed.dtype == np.uint8 else 4) + 4 * action
    else:
        rows, name = settings["n_steps"] * config.n_envs, "n_steps"
        row = 4 * (width + action + 6)
    memory = {name: float(rows) * row}
    if "history_length" in settings and settings.get("belief") != "none":
        memory["history_length"] = 4.0 * settings["history_length"] * (width + action)
    layers = network.get("net_arch") or []
    for widths in layers.values() if isinstance(layers, dict) else [layers]:
        sizes = [width, *(size for size in widths if isinstance(size, int))]
        # A weight, its gradient, and the two averages of Adam
        weights = sum(math.prod(pair) for pair in itertools.pairwise(sizes))
        memory["net_arch"] = memory.get("net_arch", 0.0) + 16.0 * weights
    for key in ("embedding_dim", "latent_dim", "lstm_hidden_size"):
        if isinstance(network.get(key), int):
            memory[key] = 16.0 * network[key] * (network[key] + width)
    return memory
