"""
What updating agents in several processes saves: ten agents at Traffic Junction (medium), with belief_ppo's own settings.

    python benchmarks/jobs.py --jobs 2 --rounds 10

Two equal teams, one with ``jobs=1`` and one with ``--jobs``, learn in turn, one iteration each (a rollout and ten updates). It
prints the wall seconds and, for an estimate on a machine that is not idle, the CPU seconds of this process. At the end both
teams must have the same parameters, bit for bit.
"""

import argparse
import statistics
import time

import torch as th

from sb3_belief.team import Team, make_team_env
from sb3_belief.zoo.config import load_config


def make_team(jobs: int) -> Team:
    """
    :param jobs: processes that update
    :return: a new team
    """
    config = load_config("belief_ppo", "traffic-junction-medium")
    env = make_team_env(config.env_id, n_envs=config.n_envs, seed=0, env_kwargs=config.env_kwargs)
    return Team(config.algo_class, config.policy, env, seed=0, device="cpu", jobs=jobs, **config.algo_kwargs)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=10, help="iterations of each team")
    parser.add_argument("--jobs", type=int, default=2, help="processes, compared with one")
    args = parser.parse_args()
    th.set_num_threads(1)

    teams = {jobs: make_team(jobs) for jobs in (1, args.jobs)}
    wall: dict[int, list[float]] = {jobs: [] for jobs in teams}
    cpu: dict[int, list[float]] = {jobs: [] for jobs in teams}
    model = next(iter(teams[1].agents.values()))
    steps = int(vars(model)["n_steps"]) * model.n_envs
    # The first fills the history, and the workers start
    for team in teams.values():
        team.learn(steps)
    for _ in range(args.rounds):
        for jobs, team in teams.items():
            start, cpu_start = time.perf_counter(), time.process_time()
            team.learn(steps, reset_num_timesteps=False)
            wall[jobs].append(time.perf_counter() - start)
            cpu[jobs].append(time.process_time() - cpu_start)
    for jobs in teams:
        print(
            f"jobs={jobs}: {statistics.median(wall[jobs]):.2f} s of wall time per iteration"
            f" (from {min(wall[jobs]):.2f} to {max(wall[jobs]):.2f}), {statistics.median(cpu[jobs]):.2f} s of CPU time here"
        )
    for name, seconds in (("wall", wall), ("CPU", cpu)):
        # Round by round: what the machine does besides changes more slowly than the teams take turns
        ratios = [one / several for one, several in zip(seconds[1], seconds[args.jobs], strict=True)]
        print(f"{name}: median ratio {statistics.median(ratios):.2f} (from {min(ratios):.2f} to {max(ratios):.2f})")
    for agent, model in teams[1].agents.items():
        other = teams[args.jobs].agents[agent].policy.state_dict()
        assert all(th.equal(value, other[name]) for name, value in model.policy.state_dict().items()), agent
    print("The same parameters in both teams.")


if __name__ == "__main__":
    main()
