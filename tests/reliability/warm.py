"""
Starts command lines in processes that need not import anything: forks of one that has imported everything.

It reads commands from its standard input, a line of JSON each, and answers each by a line: ``["start", words, output]`` by the
number of the new process, whose session is its own, and ``["status", pid]`` by how it has ended, as ``subprocess`` says it, or
null while it runs. ``["server"]`` is answered by the number of the process from which workers are forked.
"""

import gc
import json
import multiprocessing
import multiprocessing.util
import os
import resource
import signal
import sys
from multiprocessing import forkserver

from sb3_belief.common.processes import WORKERS_NEED

#: What workers need beside what all do
MORE = ["sb3_belief.belief_ppo", "sb3_contrib", "mpe2.simple_spread_v3", "lbforaging"]


def _import_all() -> None:
    import torch as th
    import torch._dynamo  # what the first optimizer would import

    import sb3_belief.belief_ppo
    import sb3_belief.cli.main
    import sb3_belief.zoo.continuation
    import sb3_belief.zoo.train  # noqa: F401

    th.set_num_threads(1)


def _become(words: list[str], output: str, limit: int | None) -> int:
    """Run a command line in this process, which has just been forked."""
    os.setsid()
    file = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
    nothing = os.open(os.devnull, os.O_RDONLY)
    for here, there in ((nothing, 0), (file, 1), (file, 2)):
        os.dup2(here, there)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if limit is not None:
        # Python ignores the signal of this limit, so that a write raises an error, as on a full disk
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
    # The server runs, but is no child of this process, which the original asks for
    forkserver._forkserver.ensure_running = lambda: None  # type: ignore[method-assign]
    from sb3_belief.cli.main import main

    try:
        return main(words)
    except SystemExit as exit_:
        return exit_.code if isinstance(exit_.code, int) else 1
    except BaseException:
        sys.excepthook(*sys.exc_info())
        return 1


def _start(words: list[str], output: str, limit: int | None = None) -> int:
    pid = os.fork()
    if pid == 0:
        status = 1
        try:
            status = _become(words, output, limit)
            # As at first, when nothing of Python's handles it
            signal.signal(signal.SIGINT, signal.SIG_DFL)
            # As at the end of any process of multiprocessing: workers are ended
            multiprocessing.util._exit_function()  # type: ignore[attr-defined]
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)
    return pid


def main() -> None:
    """Answer commands until the standard input ends."""
    multiprocessing.set_forkserver_preload([*WORKERS_NEED, *MORE, *sys.argv[1:]])
    forkserver.ensure_running()
    _import_all()
    gc.freeze()
    ended: dict[int, int] = {}
    # Not sys.stdin, which a fork would share with what it has read ahead
    unread = b""
    while True:
        while b"\n" not in unread:
            got = os.read(0, 65536)
            if not got:
                return
            unread += got
        line, _, unread = unread.partition(b"\n")
        command, *rest = json.loads(line)
        answer: int | None
        if command == "start":
            answer = _start(*rest)
        elif command == "server":
            answer = forkserver._forkserver._forkserver_pid  # type: ignore[attr-defined]
        else:
            (pid,) = rest
            if pid not in ended:
                found, status = os.waitpid(pid, os.WNOHANG)
                if found:
                    ended[pid] = os.waitstatus_to_exitcode(status)
            answer = ended.get(pid)
        os.write(1, f"{json.dumps(answer)}\n".encode())


if __name__ == "__main__":
    main()
