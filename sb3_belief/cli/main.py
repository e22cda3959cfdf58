"""The command ``sb3-belief`` with all its commands, and the script ``train.py``."""

import argparse
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

from sb3_belief.cli import (
    adapt,
    crossplay,
    demo,
    enjoy,
    envs,
    export,
    load,
    plot,
    push,
    report,
    runs,
    study,
    train,
    tune,
    watch,
)
from sb3_belief.cli.flags import STYLE, Parser
from sb3_belief.zoo.errors import ConfigError, RunFailed

_EXIT_STATUS = """\
exit status:
  0    done; with --resume also if the run has finished already
  1    the training or a run of a study failed, or an environment failed its check
  2    a setting was refused, and nothing was written
  129  SIGHUP ended the training, and the last good state was saved
  130  Ctrl-C (SIGINT), likewise
  141  the pipe that takes the output was closed
  143  SIGTERM ended the training, and the last good state was saved
"""
# What an install for serving lacks (docs/deploy.md)
_OF_THE_WHOLE_PACKAGE = {"greenlet", "pettingzoo", "sb3_contrib", "supersuit"}
# What a shell shows of a program that ended by a closed pipe: 128 and the number of SIGPIPE
_CLOSED_PIPE = 141

#: The commands: what their help says, their flags, and what they do
COMMANDS = {
    "train": train,
    "enjoy": enjoy,
    "watch": watch,
    "runs": runs,
    "plot": plot,
    "adapt": adapt,
    "crossplay": crossplay,
    "study": study,
    "report": report,
    "tune": tune,
    "export": export,
    "push": push,
    "load": load,
    "envs": envs,
    "demo": demo,
}


class _Version(argparse.Action):
    """Flag that prints the version. It is read from the file only then."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        print(f"sb3-belief {Path(__file__).parents[1].joinpath('version.txt').read_text().strip()}")
        parser.exit(0)


def make_parser() -> argparse.ArgumentParser:
    """
    Make the parser of ``sb3-belief``.

    :return: The parser
    """
    parser = Parser(
        prog="sb3-belief",
        description="Teams of independent learners.",
        epilog=_EXIT_STATUS,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(dest="subcommand", required=True, metavar=" | ".join(COMMANDS), parser_class=Parser)
    for name, command in COMMANDS.items():
        command.add_flags(commands.add_parser(name, help=command.HELP, **STYLE))
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run the command ``sb3-belief``.

    :param argv: The words after the name of the command. None for those of the process
    :return: Exit status: 0, 1 if a training failed or an environment its check, 2 if a setting was refused; 129, 130 or 143 if
        SIGHUP, Ctrl-C (SIGINT) or SIGTERM ended the training, whose last good state is saved then; 141 if the pipe that takes
        the output was closed
    """
    words = list(sys.argv[1:] if argv is None else argv)
    args = make_parser().parse_args(words)
    with _one_exit_status(ends=argv is None):
        return _run(COMMANDS[args.subcommand].run, args, ["sb3-belief", *words])


def train_main(argv: Sequence[str] | None = None) -> int:
    """
    Run the script ``train.py``, which does the same as ``sb3-belief train``.

    :param argv: The words after the name of the script. None for those of the process
    :return: Exit status, as of ``main``
    """
    words = list(sys.argv[1:] if argv is None else argv)
    parser = Parser(prog="train.py", description="Train a team from a YAML configuration.", **STYLE)
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    train.add_flags(parser)
    args = parser.parse_args(words)
    with _one_exit_status(ends=argv is None):
        return _run(train.run, args, ["python", "train.py", *words])


@contextmanager
def _one_exit_status(ends: bool) -> Iterator[None]:
    """
    Have SIGTERM and SIGHUP end the program by the exit status that they are documented to have.

    A training saves first; before and after it they would kill the process, also one that has saved because of a first signal
    and is about to say so.

    :param ends: Whether the process ends with the block, so that nothing need be put back
    """

    def leave(signum: int, _: Any) -> NoReturn:
        sys.exit(128 + signum)

    is_main = threading.current_thread() is threading.main_thread()
    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if is_main and hasattr(signal, name)]
    handled = [number for number in numbers if signal.getsignal(number) == signal.SIG_DFL]
    for number in handled:
        signal.signal(number, leave)
    try:
        yield
    finally:
        for number in handled:
            signal.signal(number, signal.SIG_IGN if ends else signal.SIG_DFL)


def _run(action: Callable[[argparse.Namespace, list[str]], int], args: argparse.Namespace, command: list[str]) -> int:
    if getattr(args, "allow_package", None) and os.getcwd() not in sys.path:
        # The user's own code may be in the current folder, as with "python -m". The folder comes last, so that nothing in it
        # hides an installed package
        sys.path.append(os.getcwd())
    try:
        status = action(args, command)
        # Otherwise a closed pipe would be found only when Python ends
        sys.stdout.flush()
        return status
    except ConfigError as error:
        print(f"Refused: {error}", file=sys.stderr)
        return 2
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing not in _OF_THE_WHOLE_PACKAGE:
            raise
        why = (
            f"this command needs {missing}, which an install for serving leaves out: install sb3-belief with all that it needs"
        )
        print(f"Refused: {why}.", file=sys.stderr)
        return 2
    except RunFailed as error:
        if isinstance(error.__cause__, BrokenPipeError) and _is_closed():
            return _CLOSED_PIPE
        print(f"Failed: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt as error:
        print("Interrupted.", file=sys.stderr)
        # By a signal before there was anything to save
        return getattr(error, "exit_status", 130)
    except BrokenPipeError:
        if not _is_closed():
            # Another pipe than the output's, such as that of a worker process
            raise
        return _CLOSED_PIPE


def _is_closed() -> bool:
    """Return whether nobody reads the output any more (``| head``). What is left of it is then thrown away."""
    try:
        # Only writing tells, and an empty line before a traceback does no harm
        print(flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return True
    return False


if __name__ == "__main__":
    sys.exit(main())
