"""The command ``export``."""

import argparse

from sb3_belief.cli.flag_types import filled_text, new_path
from sb3_belief.cli.flags import add_allow_package, add_trust

HELP = "write an agent to a file that runs without this package"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """
    Add the flags.

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
    add_allow_package(parser)
    add_trust(parser)


def run(args: argparse.Namespace, _: list[str]) -> int:
    """
    Export an agent.

    :param args: The flags
    :param _: The words of the command line, unused
    :return: Exit status
    """
    from sb3_belief.zoo.export import export

    export(args.agent, args.format, args.output, tuple(args.allow_package), args.trust)
    return 0
