"""Where the teams are in the folder of a run, and which runs are the trials of a tuning."""

from pathlib import Path

#: The team as it was at the end
TEAM = "team.zip"
#: The team of the best evaluation
BEST_MODEL = "best_model.zip"
#: Folder of the checkpoints
CHECKPOINTS = "checkpoints"
#: In the folder of a tuning its settings, its table of trials, and their storage
SPEC, TABLE, STORAGE = "tune.yml", "trials.csv", "study.db"


def is_tuning(folder: Path) -> bool:
    """
    Return whether a folder is that of a tuning. The file of one alone, which may lie anywhere, makes none.

    :param folder: The folder
    :return: Whether it has the files of one
    """
    return (folder / SPEC).is_file() and any((folder / name).is_file() for name in (TABLE, STORAGE))
