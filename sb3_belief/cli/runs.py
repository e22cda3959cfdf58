"""The command ``runs``."""

import argparse

from sb3_belief.cli.flag_types import filled_text

HELP = "list runs with their status and last score"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """
    Add the flags.

    :param parser: Parser of the command
    """
    parser.add_argument("logs", type=filled_text, nargs="?", default="logs", help="folder with runs, at any depth")


def run(args: argparse.Namespace, _: list[str]) -> int:
    """
    List runs.

    :param args: The flags
    :param _: The words of the command line, unused
    :return: Exit status
    """
    from sb3_belief.study.listing import print_runs

    print_runs(args.logs)
    return 0
