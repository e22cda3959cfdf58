"""The command ``crossplay``."""

import argparse

from sb3_belief.cli.adapt import add_play
from sb3_belief.cli.flag_types import filled_text, new_path, whole_number
from sb3_belief.cli.flags import add_common

HELP = "measure agents of each run among the agents of each other"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """
    Add the flags.

    :param parser: Parser of the command
    """
    parser.add_argument("runs", type=filled_text, nargs="+", metavar="RUN", help="folder of a run, or zip of a team")
    parser.add_argument("--env", type=filled_text, help="id of the environment, for zips of teams that were saved from Python")
    parser.add_argument("--agent", type=filled_text, help="agent that meets the others; if left out, each in turn")
    parser.add_argument(
        "--steps", type=whole_number, default=800, help="steps that it observes of them; 0 to measure only what is before"
    )
    add_play(parser)
    parser.add_argument("-o", "--output", type=new_path, default="crossplay", help="folder to write into")
    add_common(parser)


def run(args: argparse.Namespace, _: list[str]) -> int:
    """
    Measure and write cross-play.

    :param args: The flags
    :param _: The words of the command line, unused
    :return: Exit status
    """
    from sb3_belief.common.threads import use_threads
    from sb3_belief.zoo.errors import ConfigError

    use_threads(1)
    try:
        from sb3_belief.study.crossplay import CrossplayOptions, crossplay
        from sb3_belief.study.meetings import Play

        names = "env trust device agent output steps"
        folder, found = crossplay(
            CrossplayOptions(
                run=args.runs[0],
                runs=tuple(args.runs),
                **{name: getattr(args, name) for name in names.split()},
                env_kwargs=tuple(args.env_kwargs),
                extra_packages=tuple(args.allow_package),
                play=Play(args.episodes, args.n_envs, not args.stochastic, args.seed, args.repetitions),
            )
        )
    except ImportError as error:
        # An extra is missing: the message says which
        raise ConfigError(str(error)) from None
    print(f"{found}\nWrote {folder}")
    return 0
