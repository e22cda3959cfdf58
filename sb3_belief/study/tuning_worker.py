"""One of a tuning's processes, ``python -m sb3_belief.study.tuning_worker FOLDER [PACKAGE ...]``; it ends with its input."""

import os
import signal
import sys
import threading
from pathlib import Path

from sb3_belief.study.tune import work
from sb3_belief.zoo.errors import ConfigError, RunFailed


def _end_with_parent() -> None:
    # Not through sys.stdin, whose lock this thread would hold at the end of the program
    while os.read(0, 4096):
        pass
    # A training saves and ends then. Elsewhere it ends at once
    os.kill(os.getpid(), signal.SIGTERM)


def _main(words: list[str]) -> int:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        return work(Path(words[0]), tuple(words[1:]))
    except ConfigError as error:
        print(f"Refused: {error}", file=sys.stderr)
        return 2
    except RunFailed as error:
        print(f"Failed: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(_main(sys.argv[1:]))
