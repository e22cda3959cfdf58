"""Command line: ``sb3-belief train | enjoy | export | envs | demo``."""

import argparse
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

from sb3_belief.zoo.command_flags import ALGO, ENV, STYLE, add_demo, add_enjoy, add_envs, add_export, add_train
from sb3_belief.zoo.errors import ConfigError, RunFailed

_EXIT_STATUS = """\
exit status:
  0    done; with --resume also if the run has finished already
  1    the training failed, or an environment failed its check
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


class _Parser(argparse.ArgumentParser):
    """Parser that refuses words as the commands refuse settings."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"Refused: {message}. See {self.prog} --help.\n")


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
    parser = _Parser(
        prog="sb3-belief",
        description="Teams of independent learners.",
        epilog=_EXIT_STATUS,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(dest="subcommand", required=True, metavar=" | ".join(COMMANDS), parser_class=_Parser)
    for name, (text, add, _) in COMMANDS.items():
        add(commands.add_parser(name, help=text, **STYLE))
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
        return _run(COMMANDS[args.subcommand][2], args, ["sb3-belief", *words])


def train_main(argv: Sequence[str] | None = None) -> int:
    """
    Run the script ``train.py``, which does the same as ``sb3-belief train``.

    :param argv: The words after the name of the script. None for those of the process
    :return: Exit status, as of ``main``
    """
    words = list(sys.argv[1:] if argv is None else argv)
    parser = _Parser(prog="train.py", description="Train a team from a YAML configuration.", **STYLE)
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    add_train(parser)
    args = parser.parse_args(words)
    with _one_exit_status(ends=argv is None):
        return _run(_train, args, ["python", "train.py", *words])


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


# The functions below import what they need themselves: torch and Stable-Baselines3 take seconds, which --help should not


def _train(args: argparse.Namespace, command: list[str]) -> int:
    if args.resume is not None:
        return _resume(args, command)
    if args.until is not None:
        raise ConfigError("--until: extends a run, which is named by --resume; the length of a new run is -n.")
    if args.seed is not None and len(args.seed) > 1:
        seeds = " ".join(map(str, args.seed))
        raise ConfigError(
            f"--seed: a run has one seed, not {len(args.seed)}. For a run each loop over them in the shell:"
            f" for seed in {seeds}; do sb3-belief train --seed $seed ...; done"
        )
    from sb3_belief.zoo.config import load_config
    from sb3_belief.zoo.resume import resume_config
    from sb3_belief.zoo.train import TrainOptions, train

    settings: dict[str, Any] = {
        "conf_file": args.conf_file,
        "params": args.params,
        "env_kwargs": args.env_kwargs,
        "eval_env_kwargs": args.eval_env_kwargs,
        "n_timesteps": args.n_timesteps,
        "extra_packages": tuple(args.allow_package),
    }
    if args.trained_agent is None:
        config = load_config(args.algo or ALGO, args.env or ENV, **settings)
    else:
        config = resume_config(args.trained_agent, args.algo, args.env, trust=args.trust, **settings)
    names = (
        "log_folder tensorboard_log eval_freq eval_episodes n_eval_envs save_freq save_every"
        " vec_env step_timeout restart_workers device num_threads jobs on_nan progress trained_agent trust verbose"
    )
    seed = None if args.seed is None else args.seed[0]
    options = TrainOptions(
        seed=seed,
        **{name: getattr(args, name) for name in names.split()},
        extra_packages=tuple(args.allow_package),
        command=command,
    )
    return train(config, options).exit_status


#: Flags that may be given with --resume, since they do not change what is learned (--on-nan: before there is a nan)
_WITH_RESUME = ("verbose", "device", "jobs", "num_threads", "on_nan", "progress")


def _resume(args: argparse.Namespace, command: list[str]) -> int:
    given = _given_flags(command[2:])
    of_the_command = ("resume", "until", "allow_package", "trust", *_WITH_RESUME)
    refused = [flag for name, flag in given.items() if name not in of_the_command]
    if refused:
        raise ConfigError(
            f"{', '.join(refused)}: with --resume a run goes on with the settings that it had. Allowed with it: --until,"
            " --verbose, --device, --jobs, --num-threads, --on-nan, -P, --allow-package, --trust. Other settings: -i, which"
            " begins a new run."
        )
    from sb3_belief.zoo.continuation import Continuation, resume

    result = resume(
        Continuation(
            args.resume,
            args.until,
            {name: getattr(args, name) for name in _WITH_RESUME if name in given},
            tuple(args.allow_package),
            args.trust,
            command,
        )
    )
    return 0 if result is None else result.exit_status


def _given_flags(words: Sequence[str]) -> dict[str, str]:
    """Return the flags of ``train`` that were given, {name: flag}, whether or not their values are the defaults."""
    parser = _Parser(allow_abbrev=False)
    add_train(parser)
    flags = {each.dest: each.option_strings[-1] for each in parser._actions if each.option_strings}
    lists = {each.dest for each in parser._actions if isinstance(each.default, list)}
    # argparse sets the defaults of those that are not there
    absent = object()
    blank = argparse.Namespace(**{name: [] if name in lists else absent for name in flags})
    parsed = vars(parser.parse_args(list(words), blank))
    return {name: flag for name, flag in flags.items() if parsed[name] is not absent and parsed[name] != []}


def _enjoy(args: argparse.Namespace, _: list[str]) -> int:
    from sb3_belief.zoo.enjoy import EnjoyOptions, enjoy

    names = "run env trust episodes n_timesteps deterministic seed output fps device"
    enjoy(
        EnjoyOptions(
            **{name: getattr(args, name) for name in names.split()},
            env_kwargs=tuple(args.env_kwargs),
            extra_packages=tuple(args.allow_package),
        )
    )
    return 0


def _export(args: argparse.Namespace, _: list[str]) -> int:
    from sb3_belief.zoo.export import export

    export(args.agent, args.format, args.output, tuple(args.allow_package), args.trust)
    return 0


def _envs(args: argparse.Namespace, _: list[str]) -> int:
    from sb3_belief.zoo.envs import list_envs, print_env_check

    if args.what == "check":
        passed = print_env_check(args.env, args.env_kwargs, args.n_timesteps, args.seed, tuple(args.allow_package))
        return 0 if passed else 1
    print(list_envs(args.suite))
    return 0


def _demo(args: argparse.Namespace, command: list[str]) -> int:
    from sb3_belief.zoo.demo import demo

    return demo(args.n_timesteps, args.episodes, args.seed, args.log_folder, command)


#: The commands: what their help says, what adds their flags, and what they do
COMMANDS: dict[str, tuple[str, Callable[[argparse.ArgumentParser], None], Callable[[argparse.Namespace, list[str]], int]]] = {
    "train": ("train a team from a YAML configuration", add_train, _train),
    "enjoy": ("replay a trained team", add_enjoy, _enjoy),
    "export": ("write an agent to a file that runs without this package", add_export, _export),
    "envs": ("list the environments, or check one", add_envs, _envs),
    "demo": ("train, measure and show a team on Traffic Junction", add_demo, _demo),
}

if __name__ == "__main__":
    sys.exit(main())
