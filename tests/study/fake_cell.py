"""
A cell that runs in no time: ``python fake_cell.py FOLDER JOURNAL HOW``, where HOW says what it does.

It holds the cell's lock as a real one does, and writes into the journal that it has run.
"""

import json
import os
import signal
import sys
import time
from pathlib import Path

from sb3_belief.study.cell_record import Cell
from sb3_belief.zoo.errors import ConfigError
from sb3_belief.zoo.run_lock import run_lock


def run(cell, journal, how):
    record = cell.read()
    if record["status"] == "finished":
        return 0
    cell.write({**record, "status": "running", "attempts": record["attempts"] + 1})
    with open(journal, "a") as file:
        file.write(f"{cell.name} begin {time.monotonic()}\n")
    if how == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if how == "silent":
        print("Failed: no room", file=sys.stderr)
        return 1
    if how == "waits":
        sys.stdin.read()
        cell.write({**cell.read(), "status": "waiting"})
        return 143
    time.sleep(0.3)
    status = "failed" if how == "fails" else "finished"
    cell.write({**cell.read(), "status": status, "error": "broken" if how == "fails" else None})
    with open(journal, "a") as file:
        file.write(f"{cell.name} end {time.monotonic()}\n")
    return int(how == "fails")


if __name__ == "__main__":
    folder, journal, how = sys.argv[1:]
    cell = Cell(Path(folder))
    # {name of a cell: what it does}, or the same for all
    chosen = json.loads(how)
    try:
        with run_lock(cell.folder):
            sys.exit(run(cell, journal, chosen.get(cell.name, chosen.get("all", "finishes"))))
    except ConfigError:
        sys.exit(75)
