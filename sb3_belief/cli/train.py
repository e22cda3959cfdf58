"""The command ``train``."""

import argparse
from collections.abc import Sequence
from typing import Any

from sb3_belief.cli.flag_types import (
    duration_or_off,
    filled_text,
    new_path,
    positive_number,
    positive_or_off,
    process_number,
    seed_number,
    thread_number,
    whole_number,
)
from sb3_belief.cli.flags import ALGO, ENV, LIST, PAIRS, Parser, add_common, add_partners
from sb3_belief.zoo.errors import ConfigError

HELP = "train a team from a YAML configuration"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """
    Add the flags.

    :param parser: Parser of the command
    """
    parser.add_argument(
        "--algo", type=filled_text, help=f"algorithm of all agents (default: {ALGO}, or with -i that of the saved team)"
    )
    parser.add_argument(
        "--env",
        type=filled_text,
        help=f"id of the environment, see sb3-belief envs (default: {ENV}, or with -i that of the saved team)",
    )
    parser.add_argument(
        "-n", "--n-timesteps", type=positive_number, help="number of joint steps, instead of the configuration's"
    )
    parser.add_argument(
        "--seed",
        type=seed_number,
        nargs="+",
        help="seed of the team and its environments; if left out, one is drawn and recorded",
    )
    parser.add_argument("-f", "--log-folder", type=new_path, default="logs", help="folder of all runs")
    parser.add_argument("-tb", "--tensorboard-log", type=new_path, help="folder of the TensorBoard logs")
    parser.add_argument("--eval-freq", type=positive_or_off, default=25_000, help="evaluate every N joint steps; -1 for never")
    parser.add_argument("--eval-episodes", type=positive_number, default=100, help="number of episodes of an evaluation")
    parser.add_argument(
        "--n-eval-envs", type=positive_number, default=50, help="number of environment copies of an evaluation"
    )
    parser.add_argument(
        "--save-every",
        type=duration_or_off,
        default="10m",
        metavar="TIME",
        help="write a checkpoint every TIME (90s, 10m, 2h), the last two stay; -1 for none by time",
    )
    parser.add_argument(
        "--save-freq", type=positive_or_off, default=-1, help="write a checkpoint every N joint steps; -1 for none by steps"
    )
    parser.add_argument(
        "--eval-env-kwargs", **LIST, metavar="K:V", help="arguments of the environment in evaluations, beside --env-kwargs"
    )
    parser.add_argument("-params", **LIST, metavar="K:V", help=f"settings: {PAIRS}")
    add_partners(parser, "those of its 'partners' setting; beside the learners that it names")
    parser.add_argument("-conf", "--conf-file", type=filled_text, help="YAML file instead of zoo_configs/<algo>.yml")
    parser.add_argument(
        "--vec-env",
        choices=["dummy", "subproc"],
        default="dummy",
        help="whether environment copies run in this process, or in a worker process each",
    )
    parser.add_argument(
        "--step-timeout",
        type=duration_or_off,
        default=-1,
        help="end a worker process that does not answer a step within this time (90s, 10m); -1 for no limit",
    )
    parser.add_argument(
        "--restart-workers",
        type=whole_number,
        default=0,
        help="how often each copy of the environment is made anew after its process has died or hung, or it has raised an"
        " error; the broken episode is cut",
    )
    parser.add_argument(
        "--num-threads", type=thread_number, default=1, help="number of torch's threads; -1 for torch's default"
    )
    parser.add_argument(
        "--jobs",
        type=process_number,
        default=1,
        help="number of processes in which agents with on-policy algorithms learn; the result is the same for any number",
    )
    parser.add_argument(
        "--on-nan",
        choices=["raise", "skip"],
        default="raise",
        help="if an update makes loss or parameters non-finite: stop with an error, or take the update back and go on",
    )
    parser.add_argument("-P", "--progress", action="store_true", help="show a progress bar")
    parser.add_argument(
        "--track",
        choices=["wandb", "mlflow"],
        help="log to Weights & Biases or MLflow too, as their environment variables say (WANDB_MODE, MLFLOW_TRACKING_URI)",
    )
    parser.add_argument(
        "--track-project", type=filled_text, help="project, or experiment, of --track; if left out, sb3-belief"
    )
    parser.add_argument(
        "-i", "--trained-agent", type=filled_text, help="folder of a run, or zip of a team, whose training is to be continued"
    )
    parser.add_argument(
        "--resume",
        type=filled_text,
        metavar="RUN",
        help="folder of a run that was interrupted, failed or killed: it goes on from its newest checkpoint, exactly, with the"
        " options that it had",
    )
    parser.add_argument(
        "--until",
        type=positive_number,
        metavar="STEPS",
        help="with --resume: train until this number of joint steps in all, also a run that has finished",
    )
    parser.add_argument(
        "--verbose",
        type=int,
        choices=[0, 1, 2],
        default=1,
        help="0 for no output, 1 for the team's tables, 2 for those of the agents too",
    )
    add_common(parser)


def run(args: argparse.Namespace, command: list[str]) -> int:
    """
    Train a team.

    :param args: The flags
    :param command: The words of the command line
    :return: Exit status
    """
    if args.resume is not None:
        return _resume(args, command)
    if args.until is not None:
        raise ConfigError("--until: extends a run, which is named by --resume; the length of a new run is -n.")
    if args.seed is not None and len(args.seed) > 1:
        seeds = " ".join(map(str, args.seed))
        raise ConfigError(
            f"--seed: a run has one seed, not {len(args.seed)}. For a run each loop over them in the shell:"
            f" for seed in {seeds}; do sb3-belief train --seed $seed ...; done"
        )
    from sb3_belief.zoo.config import load_config
    from sb3_belief.zoo.partners import partners_of_flag
    from sb3_belief.zoo.resume import resume_config
    from sb3_belief.zoo.train import TrainOptions, train

    settings: dict[str, Any] = {
        "conf_file": args.conf_file,
        "params": args.params,
        "env_kwargs": args.env_kwargs,
        "eval_env_kwargs": args.eval_env_kwargs,
        "n_timesteps": args.n_timesteps,
        "extra_packages": tuple(args.allow_package),
        "overrides": [] if args.partners is None else [("--partners", {"partners": partners_of_flag(args.partners)})],
    }
    if args.trained_agent is None:
        config = load_config(args.algo or ALGO, args.env or ENV, **settings)
    else:
        config = resume_config(args.trained_agent, args.algo, args.env, trust=args.trust, **settings)
    names = (
        "log_folder tensorboard_log eval_freq eval_episodes n_eval_envs save_freq save_every"
        " vec_env step_timeout restart_workers device num_threads jobs on_nan progress track track_project trained_agent"
        " trust verbose"
    )
    seed = None if args.seed is None else args.seed[0]
    options = TrainOptions(
        seed=seed,
        **{name: getattr(args, name) for name in names.split()},
        extra_packages=tuple(args.allow_package),
        command=command,
    )
    return train(config, options).exit_status


#: Flags that may be given with --resume, since they do not change what is learned (--on-nan: before there is a nan)
_WITH_RESUME = ("verbose", "device", "jobs", "num_threads", "on_nan", "progress")


def _resume(args: argparse.Namespace, command: list[str]) -> int:
    given = _given_flags(command[2:])
    of_the_command = ("resume", "until", "allow_package", "trust", *_WITH_RESUME)
    refused = [flag for name, flag in given.items() if name not in of_the_command]
    if refused:
        raise ConfigError(
            f"{', '.join(refused)}: with --resume a run goes on with the settings that it had. Allowed with it: --until,"
            " --verbose, --device, --jobs, --num-threads, --on-nan, -P, --allow-package, --trust. Other settings: -i, which"
            " begins a new run."
        )
    from sb3_belief.zoo.continuation import Continuation, resume

    result = resume(
        Continuation(
            args.resume,
            args.until,
            {name: getattr(args, name) for name in _WITH_RESUME if name in given},
            tuple(args.allow_package),
            args.trust,
            command,
        )
    )
    return 0 if result is None else result.exit_status


def _given_flags(words: Sequence[str]) -> dict[str, str]:
    """Return the flags of ``train`` that were given, {name: flag}, whether or not their values are the defaults."""
    parser = Parser(allow_abbrev=False)
    add_flags(parser)
    flags = {each.dest: each.option_strings[-1] for each in parser._actions if each.option_strings}
    lists = {each.dest for each in parser._actions if isinstance(each.default, list)}
    # argparse sets the defaults of those that are not there
    absent = object()
    blank = argparse.Namespace(**{name: [] if name in lists else absent for name in flags})
    parsed = vars(parser.parse_args(list(words), blank))
    return {name: flag for name, flag in flags.items() if parsed[name] is not absent and parsed[name] != []}
