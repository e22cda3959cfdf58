"""
Our programs on the same workload (those of ``make bench``, part a), run as the peers are, and the environments alone.

    python -m benchmarks.peers.ours ippo
"""

import argparse

from mpe2 import simple_spread_v3

from benchmarks.by_hand import ByHand
from benchmarks.measure import Loop
from benchmarks.peers.child import Turns, Workload, workload
from benchmarks.teams import SPREAD_ENVS, TeamLoop, spread_settings, spread_team


def make(name: str, quick: bool) -> Loop:
    """Return the loop of a program: a team of ``"ippo"`` or ``"ppo"``, or stock PPOs without a team (``"by_hand"``)."""
    if name == "by_hand":
        return ByHand(SPREAD_ENVS, spread_settings(quick))
    return TeamLoop(spread_team(name, quick))


def environments(work: Workload) -> Loop:
    """Return a loop that only steps the environments, always with the same action. No program can be faster."""
    envs = [simple_spread_v3.parallel_env() for _ in range(work.n_envs)]
    actions = dict.fromkeys(envs[0].possible_agents, 1)
    for env in envs:
        env.reset()

    def loop() -> int:
        for _ in range(work.n_steps):
            for env in envs:
                env.step(actions)
                if not env.agents:
                    env.reset()
        return work.rows

    return loop


def main() -> None:
    """Train until there are no more requests."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=("ippo", "ppo", "by_hand", "env"))
    work, args = workload(parser)
    turns = Turns("sb3-belief", "stable-baselines3")
    loop = environments(work) if args.name == "env" else make(args.name, args.quick)
    while True:
        turns.end(loop())


if __name__ == "__main__":
    main()
