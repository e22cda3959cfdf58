"""The command ``sb3-belief export``: one agent of a team as a file that runs without this package."""

from pathlib import Path

import torch as th

from sb3_belief.common.safe_files.archive import names_in
from sb3_belief.common.safe_files.trust import Trust
from sb3_belief.export import FORMATS, export_model
from sb3_belief.team.checkpoint import read_team
from sb3_belief.team.fixed_partners.partners import load_model
from sb3_belief.zoo.errors import ConfigError, cause, suggestion
from sb3_belief.zoo.preflight import check_output
from sb3_belief.zoo.run_folder import find_team, folder_name


def export(
    given: str,
    file_format: str,
    output: str | None = None,
    extra_packages: tuple[str, ...] = (),
    trust: bool = False,
) -> Path:
    """
    Export an agent, and print what the file takes and returns.

    :param given: ``"TEAM:agent"``, where TEAM is the zip of a team or the folder of a run, or the zip of a single agent
    :param file_format: A key of ``FORMATS``
    :param output: Path of the file; None for the agent's name in the current folder
    :param extra_packages: Packages of which the file may name classes, besides the known ones
    :param trust: Whether to load a file even if it could run any code
    :return: Path of the file
    :raises ConfigError: If there is no such agent, or it cannot be exported
    """
    if output is not None:
        check_output(output, "--output")
    team, agent = _split(given)
    path = find_team(team, "export")
    trusted = Trust.of(trust, extra_packages)
    agents = _agents_of(path, trusted)
    if agents is None and agent is not None:
        raise ConfigError(f"export: {str(path)!r} is the zip of a single agent, so it has no {agent!r}. Leave out ':{agent}'.")
    if agents is not None and agent not in agents:
        unknown = "name" if agent is None else f"{str(path)!r} has no agent {agent!r}.{suggestion(agent, agents)} Name"
        raise ConfigError(f"export: {unknown} the agent: {team}:agent, one of {agents}.")
    try:
        model, statistics = load_model(path, agent or "", trusted)
        written = Path(output or folder_name(agent or path.stem) + FORMATS[file_format])
        graph = export_model(model, written, file_format, statistics)
    # A damaged file makes zipfile, pickle and torch raise whatever they raise, when it is read or when it is traced
    except Exception as error:
        # The message of a missing package is the line that installs it
        reason = str(error) if isinstance(error, ModuleNotFoundError) else cause(error)
        raise ConfigError(f"export: {str(path)!r}{'' if agent is None else f', agent {agent!r}'}: {reason}") from error
    inputs = graph.examples(1)
    print(f"Wrote {written} ({written.stat().st_size / 1024:.0f} KiB). For any number of observations B:")
    for name, tensor in zip(graph.input_names, inputs, strict=True):
        print(f"  input   {name}: {_shown(tensor)}")
    for name, tensor in graph.outputs(*inputs).items():
        print(f"  output  {name}: {_shown(tensor)}")
    return written


def _split(given: str) -> tuple[str, str | None]:
    """Return the path and the agent's name that ``TEAM:agent`` stands for; None without one."""
    # A path may have a colon of its own, on Windows after the drive
    team, colon, agent = given.rpartition(":")
    if not colon or Path(given).exists() or not agent or not Path(team).exists():
        return given, None
    return team, agent


def _agents_of(path: Path, trust: Trust) -> list[str] | None:
    """Return the agents of a saved team, or None for another zip."""
    try:
        with open(path, "rb") as file:
            names = names_in(file, str(path))
        return list(read_team(path, trust).models) if "team.json" in names else None
    # A file of an earlier version that is trusted makes pickle raise whatever it raises
    except Exception as error:
        raise ConfigError(f"export: {cause(error)}") from error


def _shown(tensor: th.Tensor) -> str:
    return f"{str(tensor.dtype).removeprefix('torch.')} [{', '.join(['B', *map(str, tensor.shape[1:])])}]"
