"""The monitor files of a team: one row per finished episode, in SB3's format."""

import os
from collections.abc import Mapping, Sequence
from typing import Any

from stable_baselines3.common.monitor import Monitor, ResultsWriter

from sb3_belief.common.continued_files import cut_file
from sb3_belief.common.file_names import file_name


def open_monitor_files(
    folder: str, agents: Sequence[str], header: dict[str, float | str], continue_from: Mapping[str, Any] | None
) -> list[ResultsWriter]:
    """
    Open the monitor files of a team and of its agents.

    :param folder: Their folder
    :param agents: Names of the agents
    :param header: What the first line of a new file says
    :param continue_from: What ``monitor_state`` of the files returned, to go on with them from there; None for new files
    :return: Their writers, the team's first
    :raises ValueError: If a file is shorter than it was
    """
    own = os.path.join(folder, "agents")
    paths = [os.path.join(folder, Monitor.EXT), *(os.path.join(own, f"{file_name(agent)}.{Monitor.EXT}") for agent in agents)]
    sizes = [] if continue_from is None else continue_from["sizes"]
    # A folder without the files is another one, in which new ones begin
    goes_on = bool(sizes) and os.path.exists(paths[0])
    if goes_on:
        for path, size in zip(paths, sizes, strict=True):
            cut_file(path, size)
    return [ResultsWriter(path, header, extra_keys=("is_success",), override_existing=not goes_on) for path in paths]


def monitor_sizes(writers: Sequence[ResultsWriter]) -> list[int]:
    """
    Return how much has been written to each file.

    :param writers: The files' writers
    :return: Numbers of bytes
    """
    for writer in writers:
        writer.file_handler.flush()
    return [os.fstat(writer.file_handler.fileno()).st_size for writer in writers]
