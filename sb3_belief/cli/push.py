"""The command ``push``."""

import argparse

from sb3_belief.cli.flag_types import filled_text
from sb3_belief.cli.flags import add_allow_package

HELP = "send a trained team to the Hugging Face hub"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """
    Add the flags.

    :param parser: Parser of the command
    """
    parser.add_argument("run", type=filled_text, help="folder of a run, or of a cell of a study")
    parser.add_argument("repo_id", type=filled_text, metavar="OWNER/NAME", help="repository, which is made if there is none")
    parser.add_argument("--private", action="store_true", help="make a new repository private")
    parser.add_argument("-m", "--message", type=filled_text, default="Add a team", help="message of the commit")
    add_allow_package(parser)


def run(args: argparse.Namespace, _: list[str]) -> int:
    """
    Send a team.

    :param args: The flags
    :param _: The words of the command line, unused
    :return: Exit status
    """
    from sb3_belief.study.pushing import run_to_push
    from sb3_belief.zoo.hub import PushOptions, push_team

    folder, final_scores = run_to_push(args.run)
    packages = tuple(args.allow_package)
    push_team(PushOptions(str(folder), args.repo_id, args.private, args.message, packages, final_scores))
    return 0
