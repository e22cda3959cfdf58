"""The command ``demo``."""

import argparse

from sb3_belief.cli.flag_types import new_path, positive_number, seed_number

HELP = "train, measure and show a team on Traffic Junction"
#: Joint steps of the demo, which take less than five minutes on two cores, and episodes of each of its measurements. With the
#: YAML entry's own number of steps the team learns more
DEMO_TIMESTEPS, DEMO_EPISODES = 60_000, 512


def add_flags(parser: argparse.ArgumentParser) -> None:
    """
    Add the flags.

    :param parser: Parser of the command
    """
    parser.add_argument(
        "-n", "--n-timesteps", type=positive_number, default=DEMO_TIMESTEPS, help="number of joint steps to train for"
    )
    parser.add_argument(
        "--episodes", type=positive_number, default=DEMO_EPISODES, help="number of episodes of each measurement"
    )
    parser.add_argument("--seed", type=seed_number, default=0, help="seed of the team and its environments")
    parser.add_argument("-f", "--log-folder", type=new_path, default="logs", help="folder of all runs")


def run(args: argparse.Namespace, command: list[str]) -> int:
    """
    Run the demo.

    :param args: The flags
    :param command: The words of the command line
    :return: Exit status
    """
    from sb3_belief.zoo.demo import demo

    return demo(args.n_timesteps, args.episodes, args.seed, args.log_folder, command)
