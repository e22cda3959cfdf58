"""What the flags of several commands share."""

import argparse
from typing import NoReturn

from sb3_belief.cli.flag_types import filled_text

#: Algorithm and environment that are trained if none is given
ALGO, ENV = "belief_ppo", "traffic-junction-medium"
PAIRS = "key:value pairs; values are read as YAML, and a dot in a key stands for a nested one"


class _HelpFormatter(argparse.ArgumentDefaultsHelpFormatter):
    """Help formatter that shows default values, except those that would tell the user nothing: None, lists and switches."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        if action.default is None or isinstance(action.default, bool | list):
            return action.help
        return super()._get_help_string(action)


#: Style of the help of a command
STYLE: dict = {"formatter_class": _HelpFormatter, "allow_abbrev": False}
# A flag with one or more words. If it is given again, its words are added
LIST: dict = {"nargs": "+", "action": "extend", "default": []}


def add_env_options(parser: argparse.ArgumentParser) -> None:
    """
    Add the flags of an environment's arguments, and of packages that may be imported.

    :param parser: Parser of the command
    """
    parser.add_argument("--env-kwargs", **LIST, metavar="K:V", help=f"arguments of the environment: {PAIRS}")
    add_allow_package(parser)


def add_allow_package(parser: argparse.ArgumentParser) -> None:
    """
    Add the flag that names packages from which may be imported.

    :param parser: Parser of the command
    """
    parser.add_argument(
        "--allow-package",
        **LIST,
        type=filled_text,
        metavar="NAME",
        help="further packages from which dotted paths in the configuration and module:callable may import; one that registers"
        " ids is imported for an id that is unknown without it",
    )


def add_trust(parser: argparse.ArgumentParser) -> None:
    """
    Add the flag that trusts a file.

    :param parser: Parser of the command
    """
    parser.add_argument(
        "--trust", action="store_true", help="load a saved team even if it could run any code, because you know who made it"
    )


def add_saved_team(parser: argparse.ArgumentParser) -> None:
    """
    Add the flags that name a saved team.

    :param parser: Parser of the command
    """
    parser.add_argument("run", type=filled_text, help="folder of a run, or zip of a team")
    parser.add_argument(
        "--env", type=filled_text, help="id of the environment, for the zip of a team that was saved from Python"
    )


def add_partners(parser: argparse.ArgumentParser, otherwise: str) -> None:
    """
    Add the flag that names partners.

    :param parser: Parser of the command
    :param otherwise: Who the partners are without it
    """
    parser.add_argument(
        "--partners",
        type=filled_text,
        metavar="FILE.yml|RUN|FOLDER",
        help="who acts for the agents that do not learn: a YAML file (learners, members, runs, ...), the folder of a run or a"
        f" zip, or a folder of runs, each of which is one of a pool; if left out, {otherwise}",
    )


def add_common(parser: argparse.ArgumentParser) -> None:
    """
    Add the flags of all commands that load a team and make its environment.

    :param parser: Parser of the command
    """
    add_env_options(parser)
    add_trust(parser)
    parser.add_argument("--device", type=filled_text, default="auto", help="device of all models: auto, cpu, cuda, ...")


class Parser(argparse.ArgumentParser):
    """Parser that refuses words as the commands refuse settings."""

    def error(self, message: str) -> NoReturn:
        """
        End the program.

        :param message: Why
        """
        self.exit(2, f"Refused: {message}. See {self.prog} --help.\n")
