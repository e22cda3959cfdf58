"""The command ``load``."""

import argparse

from sb3_belief.cli.flag_types import filled_text, new_path
from sb3_belief.cli.flags import add_allow_package

HELP = "take a trained team from the Hugging Face hub"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """
    Add the flags.

    :param parser: Parser of the command
    """
    parser.add_argument("repo_id", type=filled_text, metavar="OWNER/NAME", help="repository")
    parser.add_argument("-o", "--output", type=new_path, help="folder to make; if left out, logs/hub/OWNER/NAME")
    parser.add_argument("--revision", type=filled_text, help="branch, tag or commit; if left out, the newest state")
    add_allow_package(parser)


def run(args: argparse.Namespace, _: list[str]) -> int:
    """
    Take a team.

    :param args: The flags
    :param _: The words of the command line, unused
    :return: Exit status
    """
    from sb3_belief.zoo.hub import PullOptions, pull_team

    pull_team(PullOptions(args.repo_id, args.output, args.revision, tuple(args.allow_package)))
    return 0
