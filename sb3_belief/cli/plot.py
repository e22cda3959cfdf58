"""The command ``plot``."""

import argparse

from sb3_belief.cli.flag_types import filled_text, new_path

HELP = "draw the learning curves of runs"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """
    Add the flags.

    :param parser: Parser of the command
    """
    parser.add_argument(
        "runs", type=filled_text, nargs="+", metavar="RUN", help="folder of a run, or one with runs, which become one group"
    )
    parser.add_argument(
        "-o", "--output", type=new_path, default="learning_curves.png", help="picture to write, *.png or *.svg"
    )
    parser.add_argument("--quantity", choices=("return", "success"), help="what is drawn (default: as for report)")
    parser.add_argument("--title", type=filled_text, help="title of the picture")


def run(args: argparse.Namespace, _: list[str]) -> int:
    """
    Draw learning curves.

    :param args: The flags
    :param _: The words of the command line, unused
    :return: Exit status
    """
    from sb3_belief.zoo.errors import ConfigError

    try:
        from sb3_belief.study.plotting import plot_runs

        paths = plot_runs(args.runs, args.output, args.quantity, args.title or "")
    except ImportError as error:
        # An extra is missing: the message says which
        raise ConfigError(str(error)) from None
    print(*paths, sep="\n")
    return 0
