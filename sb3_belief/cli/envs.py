"""The command ``envs``."""

import argparse

from sb3_belief.cli.flag_types import filled_text, positive_number, seed_number
from sb3_belief.cli.flags import STYLE, add_env_options

HELP = "list the environments, or check one"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """
    Add the flags.

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
    add_env_options(check)


def run(args: argparse.Namespace, _: list[str]) -> int:
    """
    List the environments, or check one.

    :param args: The flags
    :param _: The words of the command line, unused
    :return: Exit status
    """
    from sb3_belief.zoo.envs import list_envs, print_env_check

    if args.what == "check":
        passed = print_env_check(args.env, args.env_kwargs, args.n_timesteps, args.seed, tuple(args.allow_package))
        return 0 if passed else 1
    print(list_envs(args.suite))
    return 0
