"""The flags of the commands."""

import argparse

from sb3_belief.zoo.flag_types import (
    duration_or_off,
    filled_text,
    frame_rate,
    new_path,
    positive_number,
    positive_or_off,
    process_number,
    seed_number,
    thread_number,
    whole_number,
)

#: Algorithm and environment that are trained if none is given
ALGO, ENV = "belief_ppo", "traffic-junction-medium"
_PAIRS = "key:value pairs; values are read as YAML, and a dot in a key stands for a nested one"


class _HelpFormatter(argparse.ArgumentDefaultsHelpFormatter):
    """Help formatter that shows default values, except those that would tell the user nothing: None, lists and switches."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        if action.default is None or isinstance(action.default, bool | list):
            return action.help
        return super()._get_help_string(action)


#: Style of the help of a command
STYLE: dict = {"formatter_class": _HelpFormatter, "allow_abbrev": False}
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


def add_train(parser: argparse.ArgumentParser) -> None:
    """
    Add the flags of ``train``.

    :param parser: Parser of the command
    """
    parser.add_argument(
        "--algo", type=filled_text, help=f"algorithm of all agents (default: {ALGO}, or with -i that of the saved team)"
    )
    parser.add_argument(
        "--env",
        type=filled_text,
        help=f"id of the environment, see sb3-belief envs (default: {ENV}, or with -i that of the saved team)",
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
        "--save-every",
        type=duration_or_off,
        default="10m",
        metavar="TIME",
        help="write a checkpoint every TIME (90s, 10m, 2h), the last two stay; -1 for none by time",
    )
    parser.add_argument(
        "--save-freq", type=positive_or_off, default=-1, help="write a checkpoint every N joint steps; -1 for none by steps"
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
        "--step-timeout",
        type=duration_or_off,
        default=-1,
        help="end a worker process that does not answer a step within this time (90s, 10m); -1 for no limit",
    )
    parser.add_argument(
        "--restart-workers",
        type=whole_number,
        default=0,
        help="how often each copy of the environment is made anew after its process has died or hung, or it has raised an"
        " error; the broken episode is cut",
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
    parser.add_argument(
        "--on-nan",
        choices=["raise", "skip"],
        default="raise",
        help="if an update makes loss or parameters non-finite: stop with an error, or take the update back and go on",
    )
    parser.add_argument("-P", "--progress", action="store_true", help="show a progress bar")
    parser.add_argument(
        "-i", "--trained-agent", type=filled_text, help="folder of a run, or zip of a team, whose training is to be continued"
    )
    parser.add_argument(
        "--resume",
        type=filled_text,
        metavar="RUN",
        help="folder of a run that was interrupted, failed or killed: it goes on from its newest checkpoint, exactly, with the"
        " options that it had",
    )
    parser.add_argument(
        "--until",
        type=positive_number,
        metavar="STEPS",
        help="with --resume: train until this number of joint steps in all, also a run that has finished",
    )
    parser.add_argument(
        "--verbose",
        type=int,
        choices=[0, 1, 2],
        default=1,
        help="0 for no output, 1 for the team's tables, 2 for those of the agents too",
    )
    _add_common(parser)


def add_enjoy(parser: argparse.ArgumentParser) -> None:
    """
    Add the flags of ``enjoy``.

    :param parser: Parser of the command
    """
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


def add_export(parser: argparse.ArgumentParser) -> None:
    """
    Add the flags of ``export``.

    :param parser: Parser of the command
    """
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


def add_envs(parser: argparse.ArgumentParser) -> None:
    """
    Add the flags of ``envs``.

    :param parser: Parser of the command
    """
    # "sb3-belief envs" without a further word lists all
    parser.set_defaults(suite=None)
    what = parser.add_subparsers(dest="what", metavar="list | check")
    listing = what.add_parser("list", help="list the environments, and how to install those that are missing", **STYLE)
    listing.add_argument(
        "suite", type=filled_text, nargs="?", help="suite of which all ids are listed (default: the first of each suite)"
    )
    check = what.add_parser("check", help="play an environment and report what it lacks for a team", **STYLE)
    check.add_argument("env", type=filled_text, help="id of the environment, or module:callable")
    check.add_argument("-n", "--n-timesteps", type=positive_number, default=500, help="number of steps to play")
    check.add_argument("--seed", type=seed_number, default=0, help="seed of the environment")
    _add_env_options(check)


def add_demo(parser: argparse.ArgumentParser) -> None:
    """
    Add the flags of ``demo``.

    :param parser: Parser of the command
    """
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
