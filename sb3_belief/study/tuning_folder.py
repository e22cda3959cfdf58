"""Where the folders of tunings are."""

import os
from collections.abc import Iterator
from pathlib import Path

from sb3_belief.zoo.run_files import is_tuning


def tuning_folders(folder: Path) -> Iterator[Path]:
    """
    Iterate over the folders of tunings below a folder, at any depth.

    :param folder: The folder. If it is that of a tuning itself, it is not among them
    :return: The folders, in the order of their paths
    """
    for path, folders, _ in os.walk(folder):
        if path != str(folder) and is_tuning(Path(path)):
            folders.clear()
            yield Path(path)
        folders[:] = sorted(name for name in folders if not name.startswith("."))
