"""Where the folders of tunings are."""

import os
from collections.abc import Iterator
from pathlib import Path

from sb3_belief.study.trials_table import TABLE
from sb3_belief.study.tuning_spec import SPEC
from sb3_belief.study.tuning_storage import STORAGE


def is_tuning(folder: Path) -> bool:
    """
    Return whether a folder is that of a tuning. The file of one alone, which may lie anywhere, makes none.

    :param folder: The folder
    :return: Whether it has the files of one
    """
    return (folder / SPEC).is_file() and any((folder / name).is_file() for name in (TABLE, STORAGE))


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
