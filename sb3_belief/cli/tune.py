"""The command ``tune``."""

import argparse

from sb3_belief.cli.flag_types import filled_text, new_path, process_number
from sb3_belief.cli.flags import add_allow_package

HELP = "search hyper-parameters"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """
    Add the flags.

    :param parser: Parser of the command
    """
    parser.add_argument("file", type=filled_text, help="YAML file: algorithm, environment and what is searched")
    parser.add_argument("-f", "--log-folder", type=new_path, default="logs/tuning", help="folder of all tunings")
    parser.add_argument(
        "--jobs", type=process_number, default=1, help="number of processes, each of which trains a trial at a time"
    )
    add_allow_package(parser)


def run(args: argparse.Namespace, _: list[str]) -> int:
    """
    Tune hyper-parameters.

    :param args: The flags
    :param _: The words of the command line, unused
    :return: Exit status
    """
    from sb3_belief.study.tune import TuneOptions, tune

    return tune(TuneOptions(args.file, args.log_folder, args.jobs, tuple(args.allow_package)))
