"""The files of the loggers of a team, which a run that is continued goes on with."""

import os
import shutil
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.logger import (
    CSVOutputFormat,
    KVWriter,
    Logger,
    TensorBoardOutputFormat,
    filter_excluded_keys,
)

from sb3_belief.common.continued_files import cut_table, sync_file
from sb3_belief.common.durable_files import replaced_file


class CSVLog(CSVOutputFormat):
    """
    SB3's table of logged values, which a kill leaves whole, and which can be continued.

    :param filename: The file; its folder must exist
    :param continue_from: What ``state`` returned, to go on from there if the file exists; None for a new file
    :raises ValueError: If the file is not the one that it was then
    """

    def __init__(self, filename: str, continue_from: Mapping[str, Any] | None = None):
        self._path = filename
        if continue_from is None or not os.path.exists(filename):
            super().__init__(filename)
            return
        cut_table(filename, continue_from["keys"], continue_from["size"])
        # SB3 opens a file by emptying it
        super().__init__(os.devnull)
        self.keys = list(continue_from["keys"])
        self._reopen()

    def _reopen(self) -> None:
        self.file.close()
        self.file = open(self._path, "r+")
        self.file.seek(0, os.SEEK_END)

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        if filter_excluded_keys(key_values, key_excluded, "csv").keys() <= set(self.keys):
            super().write(key_values, key_excluded, step)
            return
        # For new columns SB3 writes the whole table anew. It does so in a copy, since a kill would leave a part of it
        keys = list(self.keys)
        try:
            with replaced_file(self._path, "w+") as copy:
                self.file.seek(0)
                shutil.copyfileobj(self.file, copy)
                self.file.close()
                self.file = copy  # type: ignore[assignment]
                super().write(key_values, key_excluded, step)
        except BaseException:
            self.keys = keys
            raise
        finally:
            self._reopen()

    def state(self) -> dict[str, Any]:
        """
        Return how far the table is.

        :return: Its columns, and its number of bytes
        """
        self.file.flush()
        return {"keys": list(self.keys), "size": os.fstat(self.file.fileno()).st_size}

    def sync(self) -> None:
        """Have the system write to the disk what it holds of the file."""
        sync_file(self._path)


class TensorBoardLog(TensorBoardOutputFormat):
    """
    SB3's TensorBoard log, which can be continued.

    :param folder: Folder of the event files
    :param purge_step: First step of which earlier event files are not shown; None to show all of them
    """

    def __init__(self, folder: str, purge_step: int | None = None):
        super().__init__(folder)
        self._folder = folder
        if purge_step is not None:
            from tensorboard.compat.proto.event_pb2 import Event, SessionLog

            # As SummaryWriter(purge_step=...) does, which SB3 makes without it
            assert self.writer.file_writer is not None
            self.writer.file_writer.add_event(Event(step=purge_step, session_log=SessionLog(status=SessionLog.START)))

    def sync(self) -> None:
        """Have the system write to the disk what it holds of the newest event file."""
        self.writer.flush()
        files = sorted(Path(self._folder).glob("events.out.tfevents.*"))
        if files:
            sync_file(files[-1])


def open_logger(
    csv_folder: str | None, event_folder: str | None, continue_from: Mapping[str, Any] | None, purge_step: int | None
) -> Logger:
    """
    Make a logger that writes ``progress.csv`` and TensorBoard's events.

    :param csv_folder: Folder of ``progress.csv``; None for no table
    :param event_folder: Folder of the events; None for none
    :param continue_from: What ``CSVLog.state`` returned; None for a new table
    :param purge_step: First step of which events that are there are not shown; None to show all of them
    :return: The logger
    """
    formats: list[KVWriter] = []
    if csv_folder is not None:
        os.makedirs(csv_folder, exist_ok=True)
        formats.append(CSVLog(os.path.join(csv_folder, "progress.csv"), continue_from))
    if event_folder is not None:
        formats.append(TensorBoardLog(event_folder, purge_step))
    return Logger(csv_folder, formats)


def table_state(logger: Logger) -> dict[str, Any] | None:
    """
    Return how far a logger's table is.

    :param logger: The logger
    :return: What ``CSVLog.state`` returns; None if there is no such table
    """
    return next((each.state() for each in logger.output_formats if isinstance(each, CSVLog)), None)


def sync_logger(logger: Logger) -> None:
    """
    Have the system write to the disk what it holds of a logger's files.

    :param logger: The logger
    """
    for each in logger.output_formats:
        if isinstance(each, CSVLog | TensorBoardLog):
            each.sync()


def counters(logger: Logger) -> dict[str, Any]:
    """
    Return what has been recorded by a logger and not written yet.

    :param logger: The logger
    :return: Values, counts and exclusions by key, as plain data. Numpy's scalars are arrays without axes in lists, since a
        table shows them with their own digits
    """
    values: dict[str, Any] = {}
    for key, value in logger.name_to_value.items():
        if isinstance(value, np.generic):
            values[key] = [np.asarray(value)]
        elif isinstance(value, bool | int | float | str | np.ndarray) or value is None:
            values[key] = value
        else:
            warnings.warn(f"What was logged as {key!r} is a {type(value).__name__}, which a checkpoint does not hold.")
    return {
        "values": values,
        "counts": {key: int(count) for key, count in logger.name_to_count.items()},
        "excluded": {key: list(logger.name_to_excluded[key]) for key in values if key in logger.name_to_excluded},
    }


def put_counters_back(logger: Logger, saved: Mapping[str, Any]) -> None:
    """
    Have a logger hold what had been recorded and not written.

    :param logger: The logger
    :param saved: What ``counters`` returned
    """
    for own in (logger.name_to_value, logger.name_to_count, logger.name_to_excluded):
        own.clear()
    for key, value in saved["values"].items():
        logger.name_to_value[key] = value[0][()] if isinstance(value, list) else value
    logger.name_to_count.update(saved["counts"])
    logger.name_to_excluded.update({key: tuple(excluded) for key, excluded in saved["excluded"].items()})
