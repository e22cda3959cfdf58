"""The command ``sb3-belief export``: one agent of a team as a file that runs without this package."""

import zipfile
from pathlib import Path

import torch as th

from sb3_belief.export import FORMATS, export_model
from sb3_belief.team.fixed_partners.partners import load_model
from sb3_belief.zoo.errors import ConfigError
from sb3_belief.zoo.preflight import check_output
from sb3_belief.zoo.run_folder import find_team, folder_name
from sb3_belief.zoo.trust import check_saved_team


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
    :param extra_packages: See ``trust.check_saved_team``
    :param trust: Whether to load a file even if it could run any code
    :return: Path of the file
    :raises ConfigError: If there is no such agent, or it cannot be exported
    """
    if output is not None:
        check_output(output, "--output")
    team, agent = _split(given)
    path = find_team(team, "export")
    if not trust:
        check_saved_team(path, "export", extra_packages, or_single_agent=True)
    try:
        if agent is not None and _is_single_agent(path):
            raise ConfigError(
                f"export: {str(path)!r} is the zip of a single agent, so it has no {agent!r}. Leave out ':{agent}'."
            )
        model, statistics = load_model(path, agent or "")
        written = Path(output or folder_name(agent or path.stem) + FORMATS[file_format])
        graph = export_model(model, written, file_format, statistics)
    except (ValueError, TypeError, FileNotFoundError, ModuleNotFoundError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"export: {error}") from error
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


def _is_single_agent(path: Path) -> bool:
    if not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return "team.json" not in archive.namelist()


def _shown(tensor: th.Tensor) -> str:
    return f"{str(tensor.dtype).removeprefix('torch.')} [{', '.join(['B', *map(str, tensor.shape[1:])])}]"
