"""The command ``study``."""

import argparse

from sb3_belief.cli.flag_types import filled_text, new_path, process_number
from sb3_belief.cli.flags import add_allow_package

HELP = "train and evaluate a matrix of algorithms, environments and seeds"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """
    Add the flags.

    :param parser: Parser of the command
    """
    parser.add_argument("file", type=filled_text, help="YAML file that describes the study")
    parser.add_argument("-f", "--log-folder", type=new_path, default="logs/studies", help="folder of all studies")
    parser.add_argument(
        "--jobs",
        type=process_number,
        help="number of runs at the same time, a process each (default: 1; with --engine ray as many as there is room for)",
    )
    parser.add_argument(
        "--envs", nargs="+", type=filled_text, metavar="ID", help="start the runs in these environments of the study only"
    )
    parser.add_argument("--retry", action="store_true", help="start the runs again that failed")
    parser.add_argument("--dry-run", action="store_true", help="check everything, show the runs, and write nothing")
    parser.add_argument(
        "--engine",
        choices=["local", "ray"],
        default="local",
        help="where the runs are: in processes of this machine, or in tasks of a Ray cluster whose nodes share the log folder",
    )
    parser.add_argument(
        "--address", type=filled_text, help="with --engine ray: address of the cluster; if left out, a local one"
    )
    add_allow_package(parser)


def run(args: argparse.Namespace, _: list[str]) -> int:
    """
    Run a study, or go on with it.

    :param args: The flags
    :param _: The words of the command line, unused
    :return: Exit status
    """
    from sb3_belief.study.run_study import StudyOptions, run_study

    names = "file log_folder jobs envs retry dry_run engine address"
    return run_study(
        StudyOptions(**{name: getattr(args, name) for name in names.split()}, extra_packages=tuple(args.allow_package))
    )
