"""The command ``adapt``."""

import argparse

from sb3_belief.cli.flag_types import filled_text, new_path, positive_number, seed_number, whole_number
from sb3_belief.cli.flags import add_common, add_saved_team

HELP = "measure how a trained team adapts to partners that it has not met"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """
    Add the flags.

    :param parser: Parser of the command
    """
    add_saved_team(parser)
    parser.add_argument(
        "--partners",
        dest="pool",
        type=filled_text,
        required=True,
        metavar="POOL",
        help="YAML file of partners as for train (members, runs, ...), a run, a folder of runs, or for the environment's own"
        " partners an argument and its values: partner_seed:100..107, partner_seed:3,5,9",
    )
    parser.add_argument("--agent", type=filled_text, help="agent that meets the others; if left out, each in turn")
    for role, help in (("blind", "knows nothing of the partner"), ("oracle", "is told who the partner is")):
        parser.add_argument(f"--{role}", type=filled_text, metavar="RUN|RETURN", help=f"run that {help}, or its return")
    parser.add_argument(
        "--steps", type=whole_number, nargs="+", metavar="N", help="observed steps at which is measured (default: 0 to 800)"
    )
    add_play(parser)
    parser.add_argument("-o", "--output", type=new_path, help="folder to write into (default: adaptation in the run's folder)")
    add_common(parser)


def add_play(parser: argparse.ArgumentParser) -> None:
    """
    Add the flags of how episodes are played.

    :param parser: Parser of the command
    """
    parser.add_argument("--episodes", type=positive_number, default=20, help="episodes of each evaluation")
    parser.add_argument("--repetitions", type=positive_number, default=5, help="how often each is repeated")
    parser.add_argument("--n-envs", type=positive_number, default=8, help="copies of the environment to evaluate in")
    parser.add_argument("--stochastic", action="store_true", help="sample the actions instead of acting greedily")
    parser.add_argument("--seed", type=seed_number, default=0, help="seed of the episodes and of sampled actions")


def run(args: argparse.Namespace, _: list[str]) -> int:
    """
    Measure and write how a team adapts.

    :param args: The flags
    :param _: The words of the command line, unused
    :return: Exit status
    """
    from sb3_belief.common.threads import use_threads
    from sb3_belief.zoo.errors import ConfigError

    use_threads(1)
    try:
        from sb3_belief.study.adaptation import CHECKPOINTS, AdaptOptions, adapt
        from sb3_belief.study.meetings import Play

        names = "run env trust device pool agent blind oracle output"
        folder, found = adapt(
            AdaptOptions(
                **{name: getattr(args, name) for name in names.split()},
                env_kwargs=tuple(args.env_kwargs),
                extra_packages=tuple(args.allow_package),
                checkpoints=tuple(sorted(set(args.steps))) if args.steps else CHECKPOINTS,
                play=Play(args.episodes, args.n_envs, not args.stochastic, args.seed, args.repetitions),
            )
        )
    except ImportError as error:
        # An extra is missing: the message says which
        raise ConfigError(str(error)) from None
    print(f"{found}\nWrote {folder}")
    return 0
