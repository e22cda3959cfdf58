"""The command ``report``."""

import argparse

from sb3_belief.cli.flag_types import filled_text, new_path

HELP = "write a page that compares the runs of a study or folder, or shows a tuning"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """
    Add the flags.

    :param parser: Parser of the command
    """
    parser.add_argument(
        "source", type=filled_text, metavar="STUDY|TUNING|LOGS", help="folder of a study or tuning, or one with runs"
    )
    parser.add_argument(
        "-o",
        "--output",
        type=new_path,
        help="page to write, *.html (default: report.html in that folder); its files lie beside",
    )
    parser.add_argument(
        "--quantity",
        choices=("return", "success"),
        help="what a score is (default: success, if all environments report it, or else return)",
    )
    parser.add_argument(
        "--baseline",
        type=filled_text,
        help="algorithm that the others are compared with (default: that of the study, or ippo)",
    )


def run(args: argparse.Namespace, _: list[str]) -> int:
    """
    Write a report.

    :param args: The flags
    :param _: The words of the command line, unused
    :return: Exit status
    """
    from sb3_belief.zoo.errors import ConfigError

    try:
        from sb3_belief.study.reporting import ReportOptions, write_report

        page, summary = write_report(ReportOptions(args.source, args.output, args.quantity, args.baseline))
    except ImportError as error:
        # An extra is missing: the message says which
        raise ConfigError(str(error)) from None
    print(f"{summary}\nReport: {page}")
    return 0
