"""
The file of a saved team: a zip whose members can be checked (``safe_files.archive``), with

- ``team.json``
- ``agents/<agent>.zip`` for each agent: a normal SB3 zip that loads and predicts alone, from which we load without a pickle
- ``agents/<agent>.vecnormalize.json`` and ``.bin`` for a normalised agent: its statistics; and ``.vecnormalize.pkl``, the same
  as ``VecNormalize.save`` writes it, for ``VecNormalize.load``. We do not read it
- ``parts/<name>.json`` and ``.bin``: what else was saved

A name that cannot be part of a path is quoted there (see ``file_name``), and ``team.json`` has it as it is.
"""

import io
import os
import pathlib
import pickle
import zipfile
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import Any, BinaryIO

from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, VecTransposeImage

from sb3_belief.common.durable_files import make_folder, replaced_file
from sb3_belief.common.file_names import file_name
from sb3_belief.common.plain_data import PlainData, decode, encode
from sb3_belief.common.plain_data.kinds import name_of
from sb3_belief.common.safe_files.archive import SUMS, from_json, names_in, read_archive, to_json, write_archive
from sb3_belief.common.safe_files.models import add_plain_data, check_parameters
from sb3_belief.common.safe_files.trust import PICKLE, UNTRUSTED, Trust
from sb3_belief.common.versions import versions
from sb3_belief.team.arguments import partners_hint
from sb3_belief.team.finite import check_finite
from sb3_belief.team.model_zips import find_algorithm, load_algorithm
from sb3_belief.team.normalization import AgentNormalize

# Version of the layout above. In version 1 there were no sums, and only pickles
FORMAT = 2
# Entries of all agents, and of the team
_OF_AGENTS = ("classes", "observation_spaces", "action_spaces")
_OF_TEAM: dict[str, tuple[type, ...]] = {
    "agents": (list,),
    "seed": (int, type(None)),
    "num_timesteps": (int,),
    "normalize": (bool, dict),
    **dict.fromkeys(_OF_AGENTS, (dict,)),
}


@dataclass
class SavedTeam:
    """
    The contents of a team's file.

    :param manifest: The contents of ``team.json``
    :param models: The bytes of the agents' SB3 zips, by agent
    :param statistics: Normalisation of the agents that have one, by agent, without an environment
    :param where: What the file is called in messages
    :param trust: Whom it may name
    :param contents: What else was saved, by name: JSON and arrays
    :param size: Size of the file
    """

    manifest: dict[str, Any]
    models: dict[str, bytes]
    statistics: dict[str, VecNormalize]
    where: str = "The file"
    trust: Trust = UNTRUSTED
    contents: dict[str, tuple[bytes, bytes]] = field(default_factory=dict)
    size: int = 0

    def algo_class(self, agent: str) -> type[BaseAlgorithm]:
        """
        Import the class of an agent's model.

        :param agent: Name of the agent
        :return: The class
        :raises ValueError: If it may not be named or cannot be imported, or is not an SB3 algorithm
        """
        return find_algorithm(str(self.manifest["classes"][agent]), f"{self.where}: the agent {agent!r}", self.trust)

    def load_model(self, agent: str, custom_objects: dict[str, Any] | None = None, **kwargs: Any) -> BaseAlgorithm:
        """
        Load the model of an agent.

        :param agent: Name of the agent
        :param custom_objects: As for SB3's ``load``
        :param kwargs: Further arguments of it
        :return: The model
        :raises ValueError: If the file is damaged, or needs a pickle or a package that is not trusted
        """
        where = f"{self.where}, agent {agent!r}"
        return load_algorithm(self.algo_class(agent), self.models[agent], where, self.trust, custom_objects, **kwargs)

    def parameter_files(self) -> dict[str, io.BytesIO]:
        """
        Return files from which SB3 sets the parameters of models, by agent.

        :raises ValueError: If one holds anything but tensors
        """
        for agent, content in self.models.items():
            check_parameters(content, f"{self.where}, agent {agent!r}")
        return {agent: io.BytesIO(content) for agent, content in self.models.items()}

    def plain_part(self, name: str) -> PlainData:
        """
        Return something else that was saved with the team, for ``decode``, which is to be told what it may name.

        :param name: Name of the part, one of ``contents``
        :return: The part
        :raises ValueError: If it is damaged
        """
        text, blob = self.contents[name]
        return PlainData(from_json(text, self._member(name), self.size), blob)

    def part(self, name: str, allowed: Callable[[str], bool], accepts: Callable[[Any], bool] = lambda found: True) -> Any:
        """
        Return something else that was saved with the team.

        :param name: Name of the part, one of ``contents``
        :param allowed: Whether classes and functions of a module may be named in it
        :param accepts: Whether a class or function that has been found may be used
        :return: What ``decode`` makes of it
        :raises ValueError: If it is damaged, or names what is not allowed
        """
        return decode(self.plain_part(name), allowed, self._member(name), accepts)

    def _member(self, name: str) -> str:
        return f"{self.where}, member {f'parts/{name}.json'!r}"

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
            hint = partners_hint(self.scripted, agents)
            raise ValueError(
                f"The saved team has the agents {saved_agents}, the environment has {agents} (in this order).{hint}"
            )
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

    An existing file is replaced only when the new one is complete and on the disk.

    :param path: Path of the file (".zip" is added to a name without a suffix), or an open binary file
    :param models: Models by agent
    :param statistics: Normalisation of the agents that have one, by agent
    :param manifest: Entries of ``team.json`` besides the format, agents, classes and versions
    :param parts: What else is to be saved, by names that can be part of a path
    :raises ValueError: If something of a model or its normalisation is not finite
    """
    check_finite(models, statistics)
    classes = {agent: name_of(type(model)) for agent, model in models.items()}
    manifest = {"format": FORMAT, "agents": list(models), "classes": classes, **manifest, "versions": versions()}
    members: dict[str, bytes | Callable[[], bytes]] = {"team.json": to_json(manifest, indent=2)}
    for agent, model in models.items():
        name = f"agents/{file_name(agent)}"
        members[f"{name}.zip"] = partial(_model_zip, model)
        if agent in statistics:
            members |= _plain_members(f"{name}.vecnormalize", encode(statistics[agent], UNTRUSTED.allowed, agent))
            members[f"{name}.vecnormalize.pkl"] = pickle.dumps(statistics[agent])
    for name, data in parts.items():
        members |= _plain_members(f"parts/{name}", data)
    if isinstance(path, io.BufferedIOBase):
        write_archive(path, members)
        return
    target = pathlib.Path(path)
    if target.suffix == "":
        target = target.with_name(f"{target.name}.zip")
    make_folder(target.parent)
    with replaced_file(target) as file:
        write_archive(file, members)


def _plain_members(name: str, data: PlainData) -> dict[str, bytes | Callable[[], bytes]]:
    return {f"{name}.json": to_json(data.tree), f"{name}.bin": data.blob}


def _model_zip(model: BaseAlgorithm) -> bytes:
    buffer = io.BytesIO()
    model.save(buffer)
    add_plain_data(buffer, model)
    return buffer.getvalue()


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


def read_team(path: str | os.PathLike | io.BufferedIOBase, trust: Trust = UNTRUSTED) -> SavedTeam:
    """
    Read a team's file, without running anything of whoever made it.

    :param path: Path of the file, with or without ".zip", or an open binary file
    :param trust: Whom the file may name
    :return: Its contents
    :raises FileNotFoundError: If there is no such file
    :raises ValueError: If it is not the file of a saved team, is damaged, or is of an earlier version and not trusted
    """
    if isinstance(path, io.BufferedIOBase):
        # Of a file without a name in the file system it is a number
        name = getattr(path, "name", None)
        return _read_team(path, name if isinstance(name, str) else "The open file", trust)
    path = pathlib.Path(path)
    if not path.exists() and path.suffix != ".zip":
        path = path.with_name(f"{path.name}.zip")
    with open(path, "rb") as file:
        return _read_team(file, str(path), trust)


def _read_team(file: Any, where: str, trust: Trust) -> SavedTeam:
    try:
        names = names_in(file, where)
    except ValueError as error:
        raise ValueError(f"{where} is not a saved team, or it is damaged: {error}") from None
    if "team.json" not in names and SUMS not in names:
        hint = " It looks like the zip of a single SB3 model: load it with its own class." if "data" in names else ""
        raise ValueError(f"{where} is not a saved team, or it is damaged: it has no team.json.{hint}")
    if SUMS not in names and not trust.trust_pickle:
        raise ValueError(
            f"{where} is of an earlier version of this package, or damaged: it has no member {SUMS!r}. It would have to be"
            f" unpickled, and {PICKLE}. If you trust that person: trust_pickle=True (--trust). Saved again, it is as safe"
            " as new ones."
        )
    size = file.seek(0, io.SEEK_END)
    if SUMS not in names:
        return _read_older(file, where, trust)
    members = read_archive(file, where)
    if "team.json" not in members:
        hint = " It is the zip of a single model: load it with its own class." if "data" in names else ""
        raise ValueError(f"{where} is not a saved team, or it is damaged: it has no team.json.{hint}")
    manifest = _checked_manifest(members["team.json"], where, size, FORMAT)
    files = {agent: f"agents/{file_name(agent)}" for agent in manifest["agents"]}
    saved = SavedTeam(manifest, {}, {}, where, trust, size=size)
    for agent, name in files.items():
        if f"{name}.zip" not in members:
            raise ValueError(f"{where}, agent {agent!r}, member {f'{name}.zip'!r}: it is missing. The file is damaged.")
        saved.models[agent] = members[f"{name}.zip"]
        text, blob = (members.get(f"{name}.vecnormalize.{ending}") for ending in ("json", "bin"))
        if text is not None and blob is not None:
            here = f"{where}, agent {agent!r}, member {f'{name}.vecnormalize.json'!r}"
            found = _decoded(text, blob, here, size, trust.allowed, trust.accepts)
            if type(found) is not AgentNormalize:
                raise ValueError(f"{here}: it holds a {type(found).__name__}, not the statistics of an agent.")
            saved.statistics[agent] = found
    ends = ("parts/", ".json", ".bin")
    for name in members:
        if name.startswith(ends[0]) and name.endswith(ends[1]):
            stem = name.removesuffix(ends[1])
            saved.contents[stem.removeprefix(ends[0])] = members[name], members.get(stem + ends[2], b"")
    return saved


def _checked_manifest(text: bytes, where: str, size: int, version: int) -> dict[str, Any]:
    where = f"{where}, member 'team.json'"
    manifest = from_json(text, where, size)
    if not isinstance(manifest, dict) or manifest.get("format") != version:
        found = manifest.get("format") if isinstance(manifest, dict) else type(manifest).__name__
        raise ValueError(f"{where}: it has the team format {found!r}; this version reads {FORMAT}.")
    for entry, allowed in _OF_TEAM.items():
        if not isinstance(manifest.get(entry), allowed):
            raise ValueError(f"{where}: its entry {entry!r} is not as it was written.")
    agents = manifest["agents"]
    for entry in _OF_AGENTS:
        if not all(isinstance(agent, str) and isinstance(manifest[entry].get(agent), str) for agent in agents):
            raise ValueError(f"{where}: its entry {entry!r} does not say what each of the agents has.")
    return manifest


def _decoded(text: bytes, blob: bytes, where: str, size: int, allowed: Callable[[str], bool], *accepts: Any) -> Any:
    tree = from_json(text, where, size)
    return decode(PlainData(tree, blob), allowed, where, *accepts)


def _read_older(file: BinaryIO, where: str, trust: Trust) -> SavedTeam:
    """Read a file of format 1, which is trusted."""
    try:
        with zipfile.ZipFile(file) as archive:
            names = archive.namelist()
            manifest = _checked_manifest(archive.read("team.json"), where, 2**62, 1)
            files = {agent: agent_file(agent, names) for agent in manifest["agents"]}
            models = {agent: archive.read(f"{name}.zip") for agent, name in files.items()}
            statistics = {
                agent: AgentNormalize.from_saved(pickle.loads(archive.read(f"{name}.vecnormalize.pkl")))
                for agent, name in files.items()
                if f"{name}.vecnormalize.pkl" in names
            }
    except ValueError:
        raise
    # A damaged file makes zipfile, zlib and pickle raise whatever they raise
    except Exception as error:
        raise ValueError(f"{where} is not a saved team, or it is damaged: {error}.") from error
    return SavedTeam(manifest, models, dict(statistics), where, trust)


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
