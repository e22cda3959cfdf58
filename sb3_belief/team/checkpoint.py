"""
The file of a saved team: a zip with ``team.json`` and ``agents/<agent>.zip`` for each agent, a normal SB3 zip that loads and
predicts alone. A normalised agent also has ``agents/<agent>.vecnormalize.pkl``, as written by ``VecNormalize.save``. A name
that cannot be part of a path is quoted there (see ``file_name``), and ``team.json`` has it as it is.
"""

import io
import json
import os
import pathlib
import pickle
import tempfile
import zipfile
import zlib
from collections.abc import Collection, Mapping
from types import MappingProxyType
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, VecTransposeImage

from sb3_belief.common.file_names import file_name
from sb3_belief.common.plain_data import PlainData
from sb3_belief.common.versions import versions

# Version of the layout above
FORMAT = 1


@dataclass
class SavedTeam:
    """
    The contents of a team's file.

    :param manifest: The contents of ``team.json``
    :param models: The bytes of the agents' SB3 zips, by agent
    :param statistics: Normalisation of the agents that have one, by agent, without an environment
    """

    manifest: dict[str, Any]
    models: dict[str, bytes]
    statistics: dict[str, VecNormalize]
    parts: dict[str, PlainData] = field(default_factory=dict)

    def algo_class(self, agent: str) -> type[BaseAlgorithm]:
        """
        Import the class of an agent's model.

        :param agent: Name of the agent
        :return: The class
        :raises ValueError: If it cannot be imported, or is not an SB3 algorithm
        """
        name = str(self.manifest["classes"][agent])
        module, _, qualname = name.partition(":")
        try:
            found: Any = import_module(module)
            for part in qualname.split("."):
                found = getattr(found, part)
        except (ImportError, AttributeError, ValueError) as error:
            raise ValueError(f"The saved agent {agent!r} is a {name}, which cannot be imported: {error}.") from error
        if not (isinstance(found, type) and issubclass(found, BaseAlgorithm)):
            raise ValueError(f"The saved agent {agent!r} names {name}, which is not an SB3 algorithm.")
        return found

    @property
    def scripted(self) -> dict[str, str]:
        """The action spaces of the scripted others as text, {name: space}, in order."""
        # Files from before scripted others existed do not have the entry
        return self.manifest.get("scripted_action_spaces", {})

    def check_env(self, env: VecEnv, agents: list[str], scripted: dict[str, str]) -> None:
        """
        Check that an environment fits the saved team.

        :param env: The environment
        :param agents: Names of its agents
        :param scripted: Action spaces of its scripted others as text, by name and in order
        :raises ValueError: If agents, scripted others or spaces differ; the message says how
        """
        saved_agents = list(self.manifest["agents"])
        if saved_agents != agents:
            raise ValueError(f"The saved team has the agents {saved_agents}, the environment has {agents} (in this order).")
        differences = []
        for agent in agents:
            for name, here in (("observation", env.observation_space), ("action", env.action_space)):
                space: spaces.Space = here[agent]  # type: ignore[index]
                saved, given = self.manifest[f"{name}_spaces"][agent], str(space)
                # A team without an environment knows the spaces of its models only
                if saved not in (given, str(as_models_see(space))):
                    differences.append(f"{agent}: {name} space saved as {saved}, environment has {given}")
        if list(self.scripted.items()) != list(scripted.items()):
            differences.append(f"scripted others saved as {self.scripted}, environment has {scripted} (in this order)")
        if differences:
            raise ValueError("The environment does not fit the saved team: " + "; ".join(differences) + ".")


def as_models_see(space: spaces.Space) -> spaces.Space:
    """
    Return what becomes of an observation space in a model: SB3 puts the channels of images first.

    :param space: In an environment
    :return: In a model
    """
    if isinstance(space, spaces.Dict):
        return spaces.Dict({key: as_models_see(part) for key, part in space.spaces.items()})
    if isinstance(space, spaces.Box) and is_image_space(space) and not is_image_space_channels_first(space):
        return VecTransposeImage.transpose_space(space)
    return space


def write_team(
    path: str | os.PathLike | io.BufferedIOBase,
    models: dict[str, BaseAlgorithm],
    statistics: dict[str, VecNormalize],
    manifest: dict[str, Any],
    parts: Mapping[str, PlainData] = MappingProxyType({}),
) -> None:
    """
    Write a team's file.

    An existing file is replaced only when the new one is complete.

    :param path: Path of the file (".zip" is added to a name without a suffix), or an open binary file
    :param models: Models by agent
    :param statistics: Normalisation of the agents that have one, by agent
    :param manifest: Entries of ``team.json`` besides the format, agents, classes and versions
    """
    classes = {agent: f"{type(model).__module__}:{type(model).__qualname__}" for agent, model in models.items()}
    manifest = {"format": FORMAT, "agents": list(models), "classes": classes, **manifest, "versions": versions()}
    if isinstance(path, io.BufferedIOBase):
        _write_archive(path, models, statistics, manifest, parts)
        return
    target = pathlib.Path(path)
    if target.suffix == "":
        target = target.with_name(f"{target.name}.zip")
    target.parent.mkdir(parents=True, exist_ok=True)
    descriptor, temporary = tempfile.mkstemp(prefix=f".{target.name}.", dir=target.parent)
    try:
        with os.fdopen(descriptor, "wb") as file:
            _write_archive(file, models, statistics, manifest, parts)
        # mkstemp() makes files that only their owner may read
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, target)
    except BaseException:
        os.unlink(temporary)
        raise


def agent_file(agent: str, names: Collection[str]) -> str:
    """
    Return the name of an agent's file in a team's file.

    :param agent: Name of the agent
    :param names: What the team's file holds
    :return: The name without its ending, ``.zip`` for the model and ``.vecnormalize.pkl`` for the statistics
    """
    quoted = f"agents/{file_name(agent)}"
    # Earlier versions wrote all names as they are
    return quoted if f"{quoted}.zip" in names else f"agents/{agent}"


def read_team(path: str | os.PathLike | io.BufferedIOBase) -> SavedTeam:
    """
    Read a team's file.

    :param path: Path of the file, with or without ".zip", or an open binary file
    :return: Its contents
    :raises FileNotFoundError: If there is no such file
    :raises ValueError: If it is not the file of a saved team, or is damaged
    """
    if not isinstance(path, io.BufferedIOBase):
        path = pathlib.Path(path)
        if not path.exists() and path.suffix != ".zip":
            path = path.with_name(f"{path.name}.zip")
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            if "team.json" not in names:
                hint = " It looks like the zip of a single SB3 model: load it with its own class." if "data" in names else ""
                raise ValueError(f"{path} is not a saved team: it has no team.json.{hint}")
            manifest = json.loads(archive.read("team.json"))
            if manifest.get("format") != FORMAT:
                raise ValueError(f"{path} has the team format {manifest.get('format')!r}; this version reads {FORMAT}.")
            files = {agent: agent_file(agent, names) for agent in manifest["agents"]}
            models = {agent: archive.read(f"{file}.zip") for agent, file in files.items()}
            parts = {
                name.removeprefix("parts/").removesuffix(".json"): PlainData(
                    json.loads(archive.read(name)), archive.read(name.removesuffix("json") + "bin")
                )
                for name in names
                if name.startswith("parts/") and name.endswith(".json")
            }
            statistics = {
                agent: pickle.loads(archive.read(f"{file}.vecnormalize.pkl"))
                for agent, file in files.items()
                if f"{file}.vecnormalize.pkl" in names
            }
    except (zipfile.BadZipFile, json.JSONDecodeError, KeyError, EOFError, zlib.error, pickle.UnpicklingError) as error:
        raise ValueError(f"{path} is not a saved team, or it is damaged: {error}.") from error
    return SavedTeam(manifest, models, statistics, parts)


def spaces_manifest(
    observation_space: spaces.Dict, action_space: spaces.Dict, agents: list[str], scripted: dict[str, str]
) -> dict[str, Any]:
    """
    Describe the team's spaces for ``team.json``.

    :param observation_space: Observation space of the team
    :param action_space: Action space of the team
    :param agents: Names of the agents
    :param scripted: Action spaces of the scripted others as text, by name and in order
    :return: The entries that ``SavedTeam.check_env`` compares with
    """
    return {
        "observation_spaces": {agent: str(observation_space[agent]) for agent in agents},
        "action_spaces": {agent: str(action_space[agent]) for agent in agents},
        "scripted_action_spaces": scripted,
    }


def _write_archive(
    file: Any, models: dict[str, BaseAlgorithm], statistics: dict[str, VecNormalize], manifest: dict[str, Any], parts: Mapping[str, PlainData]
) -> None:
    # Compressed, although weights hardly shrink: if the agents' zips were stored as they are, a file cut off after one of them
    # would end as a complete zip does, and be read as the zip of that agent
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("team.json", json.dumps(manifest, indent=2))
        for name, part in parts.items():
            archive.writestr(f"parts/{name}.json", json.dumps(part.tree))
            archive.writestr(f"parts/{name}.bin", part.blob)
        for agent, model in models.items():
            buffer = io.BytesIO()
            model.save(buffer)
            archive.writestr(f"agents/{file_name(agent)}.zip", buffer.getvalue())
            if agent in statistics:
                archive.writestr(f"agents/{file_name(agent)}.vecnormalize.pkl", pickle.dumps(statistics[agent]))


def _umask() -> int:
    # It can only be read by setting it
    umask = os.umask(0)
    os.umask(umask)
    return umask
