"""
Train the full YAML entry of an environment with several beliefs and seeds, and compare the final teams.

    python -m studies.learning --algo maskable_belief_ppo --env smax/3m --quantity success --plot 3m.png

prints a row for each run: the joint steps; return and success rate over 1,024 episodes that the training did not use, with
sampled and then with greedy actions; the CPU seconds of the training; and the run's folder. Belief "none" is IPPO. A run that
the log folder already has, with the same settings, episodes and versions of the packages, is not trained again, so that a long
comparison can be made in pieces. `--plot` draws all runs.
"""

import argparse
import json
import time
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path

from sb3_belief.belief_ppo.options import BELIEFS
from sb3_belief.common.versions import versions
from sb3_belief.report.comparison import plot_comparison
from sb3_belief.report.learning_curve import QUANTITIES
from sb3_belief.team import Team
from sb3_belief.zoo.config import RunConfig, load_config
from sb3_belief.zoo.errors import ConfigError
from sb3_belief.zoo.evaluate import evaluate
from sb3_belief.zoo.preflight import check_output
from sb3_belief.zoo.run_folder import folder_name
from sb3_belief.zoo.train import TrainOptions, make_env, make_team, train

# Seed of episodes that neither the training nor its evaluations use
MEASURE_SEED = 9_000_000
_COLUMNS = (
    f"{'belief':<12} {'seed':>4} {'joint steps':>12}   "
    f"{'sampled':>8} {'success':<15} {'greedy':>8} {'success':<15} {'CPU s':>6}  folder"
)


@dataclass(frozen=True)
class Learned:
    """
    Result of one run.

    :param belief: Variant of the belief
    :param seed: Seed of the run
    :param timesteps: Joint steps of the training
    :param sampled: Mean return, success rate and its standard error (None if the environment reports no success)
    :param greedy: The same with the most likely actions
    :param seconds: CPU seconds of the training
    :param folder: Folder of the run
    """

    belief: str
    seed: int
    timesteps: int
    sampled: tuple[float, float | None, float | None]
    greedy: tuple[float, float | None, float | None]
    seconds: float
    folder: str

    def __str__(self) -> str:
        text = f"{self.belief:<12} {self.seed:>4} {self.timesteps:>12,}  "
        for mean, success, error in (self.sampled, self.greedy):
            text += f" {mean:>8.3f} {'-' if success is None else f'{success:.3f} ± {error:.3f}':<15}"
        return f"{text} {self.seconds:>6.0f}  {self.folder}"


def learn(
    belief: str, seed: int, algo: str, env_id: str, n_timesteps: int | None, episodes: int, log_folder: str
) -> Learned | None:
    """
    Train a team and evaluate it, unless the log folder has the result already.

    :param belief: Variant of the belief
    :param seed: Seed of the team and its environment
    :param algo: Algorithm with a belief
    :param env_id: Id of the environment
    :param n_timesteps: Joint steps, None for those of the YAML entry
    :param episodes: Number of episodes of each evaluation
    :param log_folder: Folder of all runs
    :return: The result, None if the training was interrupted
    """
    config = load_config(algo, env_id, params=[f"belief:{belief}"], n_timesteps=n_timesteps)
    # The file also holds what decides the result: with a changed YAML entry, say, the run is trained again
    decisive = {"config": config.to_yaml(), "episodes": episodes, "versions": versions()}
    name = f"{algo}-{folder_name(env_id)}-{belief}-{config.n_timesteps}-{seed}"
    path = Path(log_folder, "learning", f"{name}.json")
    if path.is_file():
        record = json.loads(path.read_text(encoding="utf-8"))
        if {key: record.get(key) for key in decisive} == decisive:
            kept = record["learned"]
            # JSON knows no tuples
            return Learned(**{**kept, "sampled": tuple(kept["sampled"]), "greedy": tuple(kept["greedy"])})
    start = time.process_time()
    # No evaluations during the training, since they would count as its time
    result = train(config, TrainOptions(seed=seed, log_folder=log_folder, eval_freq=-1, verbose=0))
    seconds = time.process_time() - start
    if not result.finished:
        return None
    sampled, greedy = (_measure(config, result.team, episodes, deterministic) for deterministic in (False, True))
    learned = Learned(belief, seed, result.team.num_timesteps, sampled, greedy, seconds, str(result.folder))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**decisive, "learned": asdict(learned)}, indent=2), encoding="utf-8")
    return learned


def _measure(config: RunConfig, team: Team, episodes: int, deterministic: bool) -> tuple[float, float | None, float | None]:
    env = make_env(config, 64, MEASURE_SEED)
    outcome = evaluate(team, env, episodes, deterministic)
    env.close()
    return float(outcome.returns.mean()), outcome.success_rate, outcome.standard_error


def check_plot(path: str, quantity: str, config: RunConfig) -> None:
    """
    Check that the runs can be plotted in the end, before any of them is trained.

    :param path: Picture to write
    :param quantity: What it shows
    :param config: Configuration of one of the runs
    :raises ConfigError: If the picture cannot be written, or the environment does not report what it shows
    """
    if find_spec("matplotlib") is None:
        raise ConfigError("--plot: plots need matplotlib: pip install 'sb3-belief[plots]'.")
    from matplotlib.figure import Figure

    formats = Figure().canvas.get_supported_filetypes()
    if Path(path).suffix[1:].lower() not in formats:
        raise ConfigError(f"--plot: {path!r} must end in one of {', '.join(f'.{name}' for name in formats)}.")
    check_output(path, "--plot")
    if quantity == "success" and not _reports_success(config):
        raise ConfigError(f"--quantity: {config.env_id} reports no successes; draw --quantity return.")


def _reports_success(config: RunConfig) -> bool:
    """Play one episode with an untrained team and return whether its end says if it was a success."""
    env = make_env(config, 1, MEASURE_SEED)
    try:
        return evaluate(make_team(config, TrainOptions(verbose=0), env, 0), env, 1).success_rate is not None
    finally:
        env.close()


def compare(beliefs: Iterable[str], seeds: Iterable[int], jobs: int, **settings: object) -> list[Learned]:
    """
    Train several runs in processes, and print the result of each.

    :param beliefs: Variants of the belief
    :param seeds: Seeds of each variant
    :param jobs: Number of processes
    :param settings: Further arguments of ``learn``
    :return: The results of all runs that were finished
    """
    pairs = [(belief, seed) for belief in beliefs for seed in seeds]
    run = partial(learn, **settings)  # type: ignore[arg-type]
    learned = []
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        for result in pool.map(run, *zip(*pairs, strict=True)):
            if result is not None:
                print(result, flush=True)
                learned.append(result)
    return learned


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algo", default="belief_ppo", choices=["belief_ppo", "maskable_belief_ppo"])
    parser.add_argument("--env", default="traffic-junction-medium")
    parser.add_argument("--beliefs", nargs="+", default=["dynamic", "none", "wide"], choices=BELIEFS)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("-n", "--n-timesteps", type=int, help="joint steps, instead of the YAML entry's")
    parser.add_argument("--episodes", type=int, default=1024)
    parser.add_argument("-f", "--log-folder", default="logs")
    parser.add_argument("--plot", help="picture of the learning curves to write")
    parser.add_argument("--quantity", default="return", choices=list(QUANTITIES), help="what it shows")
    args = parser.parse_args()

    if args.plot:
        try:
            check_plot(args.plot, args.quantity, load_config(args.algo, args.env))
        except ConfigError as error:
            parser.error(str(error))
    print(_COLUMNS, flush=True)
    settings = dict(algo=args.algo, env_id=args.env, n_timesteps=args.n_timesteps)
    results = compare(args.beliefs, args.seeds, args.jobs, **settings, episodes=args.episodes, log_folder=args.log_folder)
    if args.plot:
        runs = {belief: [r.folder for r in results if r.belief == belief] for belief in args.beliefs}
        title = f"{args.env}: mean of {len(args.seeds)} seeds, and lowest to highest"
        print(plot_comparison(runs, args.plot, args.quantity, title=title))


if __name__ == "__main__":
    main()
