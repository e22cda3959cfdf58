"""
The file of a saved team: one zip with ``team.json`` and, for each agent, ``agents/<agent>.zip`` (a normal SB3 zip, which loads
and predicts alone) and, if it is normalised, ``agents/<agent>.vecnormalize.pkl`` (what ``VecNormalize.save`` writes).
"""

import io
import json
import os
import pathlib
import pickle
import tempfile
import zipfile
import zlib
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_belief.common.versions import versions

FORMAT = 1


@dataclass
class SavedTeam:
    """
    A team as it stands in a file.

    :param manifest: what ``team.json`` says
    :param models: {agent: bytes of its SB3 zip}
    :param statistics: {agent: its normalisation}, without an environment
    """

    manifest: dict[str, Any]
    models: dict[str, bytes]
    statistics: dict[str, VecNormalize]

    def algo_class(self, agent: str) -> type[BaseAlgorithm]:
        """
        :param agent: name of the agent
        :return: class of its model
        :raises ValueError: if there is no such class here
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
        """
        :return: {name of a scripted other: its action space in words}, in order; files that tell nothing of them had none
        """
        return self.manifest.get("scripted_action_spaces", {})

    def check_env(self, env: VecEnv, agents: list[str], scripted: dict[str, str]) -> None:
        """
        :param env: the environment that the team is to have
        :param agents: its agents
        :param scripted: its scripted others and their action spaces in words, in order
        :raises ValueError: if agents, scripted others or spaces differ, saying how
        """
        saved_agents = list(self.manifest["agents"])
        if saved_agents != agents:
            raise ValueError(f"The saved team has the agents {saved_agents}, the environment has {agents} (in this order).")
        differences = []
        for agent in agents:
            for name, here in (("observation", env.observation_space), ("action", env.action_space)):
                saved, given = self.manifest[f"{name}_spaces"][agent], str(here[agent])  # type: ignore[index]
                if saved != given:
                    differences.append(f"{agent}: {name} space saved as {saved}, environment has {given}")
        if list(self.scripted.items()) != list(scripted.items()):
            differences.append(f"scripted others saved as {self.scripted}, environment has {scripted} (in this order)")
        if differences:
            raise ValueError("The environment does not fit the saved team: " + "; ".join(differences) + ".")


def write_team(
    path: str | os.PathLike | io.BufferedIOBase,
    models: dict[str, BaseAlgorithm],
    statistics: dict[str, VecNormalize],
    manifest: dict[str, Any],
) -> None:
    """
    Write a team's file at once: a file already there stays whole until the new one is.

    :param path: where to (".zip" is added to a name without a suffix), or an open binary file
    :param models: {agent: model}
    :param statistics: {agent: normalisation} of the agents that have one
    :param manifest: what goes into ``team.json`` besides the classes and versions
    """
    classes = {agent: f"{type(model).__module__}:{type(model).__qualname__}" for agent, model in models.items()}
    manifest = {"format": FORMAT, "agents": list(models), "classes": classes, **manifest, "versions": versions()}
    if isinstance(path, io.BufferedIOBase):
        _write_archive(path, models, statistics, manifest)
        return
    target = pathlib.Path(path)
    if target.suffix == "":
        target = target.with_name(f"{target.name}.zip")
    target.parent.mkdir(parents=True, exist_ok=True)
    descriptor, temporary = tempfile.mkstemp(prefix=f".{target.name}.", dir=target.parent)
    try:
        with os.fdopen(descriptor, "wb") as file:
            _write_archive(file, models, statistics, manifest)
        # mkstemp makes files that only their owner may read
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, target)
    except BaseException:
        os.unlink(temporary)
        raise


def read_team(path: str | os.PathLike | io.BufferedIOBase) -> SavedTeam:
    """
    :param path: of the file, with or without ".zip", or an open binary file
    :return: what it holds
    :raises FileNotFoundError: if there is none
    :raises ValueError: if it is not a whole file of a saved team
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
            models = {agent: archive.read(f"agents/{agent}.zip") for agent in manifest["agents"]}
            statistics = {
                agent: pickle.loads(archive.read(f"agents/{agent}.vecnormalize.pkl"))
                for agent in manifest["agents"]
                if f"agents/{agent}.vecnormalize.pkl" in names
            }
    except (zipfile.BadZipFile, json.JSONDecodeError, KeyError, EOFError, zlib.error, pickle.UnpicklingError) as error:
        raise ValueError(f"{path} is not a saved team, or it is damaged: {error}.") from error
    return SavedTeam(manifest, models, statistics)


def spaces_manifest(
    observation_space: spaces.Dict, action_space: spaces.Dict, agents: list[str], scripted: dict[str, str]
) -> dict[str, Any]:
    """
    :param observation_space: of the team
    :param action_space: of the team
    :param agents: names of the agents
    :param scripted: the scripted others and their action spaces in words, in order
    :return: the entries of ``team.json`` that ``SavedTeam.check_env`` compares with
    """
    return {
        "observation_spaces": {agent: str(observation_space[agent]) for agent in agents},
        "action_spaces": {agent: str(action_space[agent]) for agent in agents},
        "scripted_action_spaces": scripted,
    }


def _write_archive(
    file: Any, models: dict[str, BaseAlgorithm], statistics: dict[str, VecNormalize], manifest: dict[str, Any]
) -> None:
    # Compressed, although weights hardly get smaller: else a file cut off after an agent's zip would pass for a whole one
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("team.json", json.dumps(manifest, indent=2))
        for agent, model in models.items():
            buffer = io.BytesIO()
            model.save(buffer)
            archive.writestr(f"agents/{agent}.zip", buffer.getvalue())
            if agent in statistics:
                archive.writestr(f"agents/{agent}.vecnormalize.pkl", pickle.dumps(statistics[agent]))


def _umask() -> int:
    # There is no other way to read it
    umask = os.umask(0)
    os.umask(umask)
    return umask
