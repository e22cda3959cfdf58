"""
Train the full YAML entry of an environment with several seeds and measure the final teams, greedy, on episodes of their own.

    python benchmarks/learning.py --algos belief_ppo ippo --seeds 0 1 2

prints a row per run: success rate over 1,024 episodes with its standard error, return, CPU seconds and the run's folder.
"""

import argparse
import time

from sb3_belief.zoo.config import load_config
from sb3_belief.zoo.evaluate import evaluate
from sb3_belief.zoo.train import TrainOptions, make_env, train

# Episodes that neither the training nor its evaluations see
MEASURE_SEED = 9_000_000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algos", nargs="+", default=["belief_ppo", "ippo"])
    parser.add_argument("--env", default="traffic-junction-medium")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("-n", "--n-timesteps", type=int, help="joint steps, instead of the YAML entry's")
    parser.add_argument("--episodes", type=int, default=1024)
    parser.add_argument("-f", "--log-folder", default="logs")
    args = parser.parse_args()

    print("algo        seed  joint steps  success          return  CPU s  folder", flush=True)
    for algo in args.algos:
        config = load_config(algo, args.env, n_timesteps=args.n_timesteps)
        for seed in args.seeds:
            start = time.process_time()
            # No evaluations on the way: they would count as training time
            result = train(config, TrainOptions(seed=seed, log_folder=args.log_folder, eval_freq=-1, verbose=0))
            seconds = time.process_time() - start
            if not result.finished:
                return
            env = make_env(config, 64, MEASURE_SEED)
            outcome = evaluate(result.team, env, args.episodes)
            env.close()
            success = "-" if outcome.success_rate is None else f"{outcome.success_rate:.3f} ± {outcome.standard_error:.3f}"
            row = f"{algo:<10} {seed:>5} {result.team.num_timesteps:>12,}  {success:<15} {outcome.returns.mean():>7.2f}"
            print(f"{row} {seconds:>6.0f}  {result.folder}", flush=True)


if __name__ == "__main__":
    main()
