"""The command ``enjoy``."""

import argparse

from sb3_belief.cli.flag_types import frame_rate, new_path, positive_number, seed_number
from sb3_belief.cli.flags import add_common, add_partners, add_saved_team

HELP = "replay a trained team"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """
    Add the flags.

    :param parser: Parser of the command
    """
    add_saved_team(parser)
    add_partners(parser, "those of its run")
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--episodes", type=positive_number, default=1, help="number of episodes to play")
    length.add_argument("-n", "--n-timesteps", type=positive_number, help="number of steps to play instead")
    manner = parser.add_mutually_exclusive_group()
    manner.add_argument(
        "--deterministic", dest="deterministic", action="store_true", default=True, help="act greedily (default)"
    )
    manner.add_argument("--stochastic", dest="deterministic", action="store_false", help="sample the actions")
    parser.add_argument(
        "--observe", action="store_true", help="let beliefs remember what the others do here; nothing is saved of it"
    )
    parser.add_argument("--seed", type=seed_number, default=0, help="seed of the environment and of sampled actions")
    parser.add_argument("--output", type=new_path, help=".gif or .mp4 file to write; if left out, a window is opened")
    parser.add_argument(
        "--fps", type=frame_rate, help="frames per second of the file; if left out, the environment's own rate"
    )
    add_common(parser)


def run(args: argparse.Namespace, _: list[str]) -> int:
    """
    Replay a team.

    :param args: The flags
    :param _: The words of the command line, unused
    :return: Exit status
    """
    from sb3_belief.common.threads import use_threads
    from sb3_belief.zoo.enjoy import EnjoyOptions, enjoy

    use_threads(1)
    names = "run env partners trust episodes n_timesteps deterministic seed output fps device observe"
    enjoy(
        EnjoyOptions(
            **{name: getattr(args, name) for name in names.split()},
            env_kwargs=tuple(args.env_kwargs),
            extra_packages=tuple(args.allow_package),
        )
    )
    return 0
