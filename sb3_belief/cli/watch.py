"""The command ``watch``."""

import argparse

from sb3_belief.cli.flag_types import filled_text, new_path, positive_number, seed_number
from sb3_belief.cli.flags import add_common, add_saved_team

HELP = "show what the agents of a trained team believe of each other"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """
    Add the flags.

    :param parser: Parser of the command
    """
    add_saved_team(parser)
    parser.add_argument("--agent", type=filled_text, help="agent to show at first; if left out, the one that sees others most")
    parser.add_argument("--episodes", type=positive_number, default=1, help="number of episodes to record")
    parser.add_argument("--stochastic", action="store_true", help="sample the actions instead of acting greedily")
    parser.add_argument("--seed", type=seed_number, default=0, help="seed of the environment and of sampled actions")
    parser.add_argument(
        "--output", type=new_path, help="HTML file to write; if left out, viewer.html in the run's folder, or beside the zip"
    )
    parser.add_argument("--no-open", action="store_true", help="write the page without opening it in the browser")
    add_common(parser)


def run(args: argparse.Namespace, _: list[str]) -> int:
    """
    Write and open the viewer of a team.

    :param args: The flags
    :param _: The words of the command line, unused
    :return: Exit status
    """
    from sb3_belief.common.threads import use_threads
    from sb3_belief.zoo.watch import WatchOptions, watch

    use_threads(1)
    names = "run env trust episodes seed agent output device"
    watch(
        WatchOptions(
            **{name: getattr(args, name) for name in names.split()},
            deterministic=not args.stochastic,
            opens=not args.no_open,
            env_kwargs=tuple(args.env_kwargs),
            extra_packages=tuple(args.allow_package),
        )
    )
    return 0
