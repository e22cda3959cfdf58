"""Command line: ``sb3-belief train | enjoy | export | envs | demo``."""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from sb3_belief.zoo.errors import ConfigError
from sb3_belief.zoo.flag_types import (
    filled_text,
    frame_rate,
    new_path,
    positive_number,
    positive_or_off,
    process_number,
    seed_number,
    thread_number,
)

_ALGO, _ENV = "belief_ppo", "traffic-junction-medium"
_PAIRS = "key:value pairs; values are read as YAML, and a dot in a key stands for a nested one"
# What a shell shows of a program that ended by a closed pipe: 128 and the number of SIGPIPE
# What an install for serving lacks (docs/deploy.md)
_OF_THE_WHOLE_PACKAGE = {"greenlet", "pettingzoo", "sb3_contrib", "supersuit"}
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
    parser = _Parser(prog="sb3-belief", description="Teams of independent learners.", allow_abbrev=False)
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(dest="subcommand", required=True, metavar=" | ".join(COMMANDS), parser_class=_Parser)
    for name, (text, add, _) in COMMANDS.items():
        add(commands.add_parser(name, help=text, **_STYLE))
    return parser


class _HelpFormatter(argparse.ArgumentDefaultsHelpFormatter):
    """Help formatter that shows default values, except those that would tell the user nothing: None, lists and switches."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        if action.default is None or isinstance(action.default, bool | list):
            return action.help
        return super()._get_help_string(action)


_STYLE: dict = {"formatter_class": _HelpFormatter, "allow_abbrev": False}
# A flag with one or more words. If it is given again, its words are added
_LIST: dict = {"nargs": "+", "action": "extend", "default": []}


def _add_env_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--env-kwargs", **_LIST, metavar="K:V", help=f"arguments of the environment: {_PAIRS}")
    _add_allow_package(parser)


def _add_allow_package(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--allow-package",
        **_LIST,
        type=filled_text,
        metavar="NAME",
        help="further packages from which dotted paths in the configuration and module:callable may import; one that registers"
        " ids is imported for an id that is unknown without it",
    )


def _add_trust(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--trust", action="store_true", help="load a saved team even if it could run any code, because you know who made it"
    )


def _add_common(parser: argparse.ArgumentParser) -> None:
    _add_env_options(parser)
    _add_trust(parser)
    parser.add_argument("--device", type=filled_text, default="auto", help="device of all models: auto, cpu, cuda, ...")


def _add_train(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--algo", type=filled_text, help=f"algorithm of all agents (default: {_ALGO}, or with -i that of the saved team)"
    )
    parser.add_argument(
        "--env",
        type=filled_text,
        help=f"id of the environment, see sb3-belief envs (default: {_ENV}, or with -i that of the saved team)",
    )
    parser.add_argument(
        "-n", "--n-timesteps", type=positive_number, help="number of joint steps, instead of the configuration's"
    )
    parser.add_argument(
        "--seed",
        type=seed_number,
        nargs="+",
        help="seed of the team and its environments; if left out, one is drawn and recorded",
    )
    parser.add_argument("-f", "--log-folder", type=new_path, default="logs", help="folder of all runs")
    parser.add_argument("-tb", "--tensorboard-log", type=new_path, help="folder of the TensorBoard logs")
    parser.add_argument("--eval-freq", type=positive_or_off, default=25_000, help="evaluate every N joint steps; -1 for never")
    parser.add_argument("--eval-episodes", type=positive_number, default=100, help="number of episodes of an evaluation")
    parser.add_argument(
        "--n-eval-envs", type=positive_number, default=50, help="number of environment copies of an evaluation"
    )
    parser.add_argument(
        "--save-freq", type=positive_or_off, default=-1, help="save every N joint steps; -1 for only at the end"
    )
    parser.add_argument(
        "--eval-env-kwargs", **_LIST, metavar="K:V", help="arguments of the environment in evaluations, beside --env-kwargs"
    )
    parser.add_argument("-params", **_LIST, metavar="K:V", help=f"settings: {_PAIRS}")
    parser.add_argument("-conf", "--conf-file", type=filled_text, help="YAML file instead of zoo_configs/<algo>.yml")
    parser.add_argument(
        "--vec-env",
        choices=["dummy", "subproc"],
        default="dummy",
        help="whether environment copies run in this process, or in a worker process each",
    )
    parser.add_argument(
        "--num-threads", type=thread_number, default=1, help="number of torch's threads; -1 for torch's default"
    )
    parser.add_argument(
        "--jobs",
        type=process_number,
        default=1,
        help="number of processes in which agents with on-policy algorithms learn; the result is the same for any number",
    )
    parser.add_argument("-P", "--progress", action="store_true", help="show a progress bar")
    parser.add_argument(
        "-i", "--trained-agent", type=filled_text, help="folder of a run, or zip of a team, whose training is to be continued"
    )
    parser.add_argument(
        "--verbose",
        type=int,
        choices=[0, 1, 2],
        default=1,
        help="0 for no output, 1 for the team's tables, 2 for those of the agents too",
    )
    _add_common(parser)


def _add_enjoy(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", type=filled_text, help="folder of a run, or zip of a team")
    parser.add_argument(
        "--env", type=filled_text, help="id of the environment, for the zip of a team that was saved from Python"
    )
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--episodes", type=positive_number, default=1, help="number of episodes to play")
    length.add_argument("-n", "--n-timesteps", type=positive_number, help="number of steps to play instead")
    manner = parser.add_mutually_exclusive_group()
    manner.add_argument(
        "--deterministic", dest="deterministic", action="store_true", default=True, help="act greedily (default)"
    )
    manner.add_argument("--stochastic", dest="deterministic", action="store_false", help="sample the actions")
    parser.add_argument("--seed", type=seed_number, default=0, help="seed of the environment")
    parser.add_argument("--output", type=new_path, help=".gif or .mp4 file to write; if left out, a window is opened")
    parser.add_argument(
        "--fps", type=frame_rate, help="frames per second of the file; if left out, the environment's own rate"
    )
    _add_common(parser)


def _add_export(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "agent",
        type=filled_text,
        metavar="TEAM:agent",
        help="folder of a run or zip of a team, and the agent; or the zip of a single agent",
    )
    parser.add_argument("--format", choices=["onnx", "torch"], default="onnx", help="format of the file")
    parser.add_argument(
        "--output", type=new_path, help="file to write, .onnx or .pt2; if left out, the agent's name in the current folder"
    )
    _add_allow_package(parser)
    _add_trust(parser)


def _add_envs(parser: argparse.ArgumentParser) -> None:
    # "sb3-belief envs" without a further word lists all
    parser.set_defaults(suite=None)
    what = parser.add_subparsers(dest="what", metavar="list | check")
    listing = what.add_parser("list", help="list the environments, and how to install those that are missing", **_STYLE)
    listing.add_argument(
        "suite", type=filled_text, nargs="?", help="suite of which all ids are listed (default: the first of each suite)"
    )
    check = what.add_parser("check", help="play an environment and report what it lacks for a team", **_STYLE)
    check.add_argument("env", type=filled_text, help="id of the environment, or module:callable")
    check.add_argument("-n", "--n-timesteps", type=positive_number, default=500, help="number of steps to play")
    check.add_argument("--seed", type=seed_number, default=0, help="seed of the environment")
    _add_env_options(check)


def _add_demo(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "-n", "--n-timesteps", type=positive_number, default=DEMO_TIMESTEPS, help="number of joint steps to train for"
    )
    parser.add_argument(
        "--episodes", type=positive_number, default=DEMO_EPISODES, help="number of episodes of each measurement"
    )
    parser.add_argument("--seed", type=seed_number, default=0, help="seed of the team and its environments")
    parser.add_argument("-f", "--log-folder", type=new_path, default="logs", help="folder of all runs")


#: Joint steps of the demo, which take less than five minutes on two cores, and episodes of each of its measurements. With the
#: YAML entry's own number of steps the team learns more
DEMO_TIMESTEPS, DEMO_EPISODES = 60_000, 512


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run the command ``sb3-belief``.

    :param argv: The words after the name of the command. None for those of the process
    :return: Exit status: 0, 1 if an environment failed its check, 2 if a setting was refused, 130 after Ctrl-C, 141 if the
        pipe that takes the output was closed
    """
    argv = list(sys.argv[1:] if argv is None else argv)
    args = make_parser().parse_args(argv)
    return _run(COMMANDS[args.subcommand][2], args, ["sb3-belief", *argv])


def train_main(argv: Sequence[str] | None = None) -> int:
    """
    Run the script ``train.py``, which does the same as ``sb3-belief train``.

    :param argv: The words after the name of the script. None for those of the process
    :return: Exit status, as of ``main``
    """
    argv = list(sys.argv[1:] if argv is None else argv)
    parser = _Parser(prog="train.py", description="Train a team from a YAML configuration.", **_STYLE)
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    _add_train(parser)
    return _run(_train, parser.parse_args(argv), ["python", "train.py", *argv])


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
    except KeyboardInterrupt:
        print("Interrupted.", file=sys.stderr)
        return 130
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
        config = load_config(args.algo or _ALGO, args.env or _ENV, **settings)
    else:
        config = resume_config(args.trained_agent, args.algo, args.env, trust=args.trust, **settings)
    names = (
        "log_folder tensorboard_log eval_freq eval_episodes n_eval_envs save_freq"
        " vec_env device num_threads jobs progress trained_agent trust verbose"
    )
    seed = None if args.seed is None else args.seed[0]
    options = TrainOptions(
        seed=seed,
        **{name: getattr(args, name) for name in names.split()},
        extra_packages=tuple(args.allow_package),
        command=command,
    )
    return 0 if train(config, options).finished else 130


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
    "train": ("train a team from a YAML configuration", _add_train, _train),
    "enjoy": ("replay a trained team", _add_enjoy, _enjoy),
    "export": ("write an agent to a file that runs without this package", _add_export, _export),
    "envs": ("list the environments, or check one", _add_envs, _envs),
    "demo": ("train, measure and show a team on Traffic Junction", _add_demo, _demo),
}

if __name__ == "__main__":
    sys.exit(main())
