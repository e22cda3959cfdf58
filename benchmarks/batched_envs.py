"""
Joint steps per CPU second of environments that step all copies in one batch, against the same copies one by one.

    python -m benchmarks.batched_envs traffic-junction-medium
    python -m benchmarks.batched_envs smax/3s5z        # where jaxmarl is installed

Observations, masks, visibility, rewards, infos and resets are all included; compilation is not. The policy is random among the
actions that the masks allow, and the cost of choosing is included, too.
"""

import argparse

import numpy as np

from benchmarks.measure import Loop, ratio
from benchmarks.report import Report
from sb3_belief import make_team_env
from sb3_belief.envs import make_parallel_env

SIZES = (8, 64)


def random_actions(masks: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return random actions, int [...], among those that the masks, bool [..., k], allow."""
    return (rng.random(masks.shape) * masks).argmax(axis=-1)


def batched(env_id: str, n_envs: int, n_steps: int) -> Loop:
    """Return a loop over steps of all copies at once."""
    env = make_team_env(env_id, n_envs=n_envs, seed=0)
    env.reset()
    rng = np.random.default_rng(0)
    n_actions = env.action_space[env.possible_agents[0]].n  # type: ignore[index]
    everything = np.ones((len(env.possible_agents), n_envs, n_actions), dtype=bool)

    def loop() -> int:
        for _ in range(n_steps):
            masks = env.action_masks()
            chosen = random_actions(everything if masks is None else np.stack(list(masks.values())), rng)
            env.step(dict(zip(env.possible_agents, chosen, strict=True)))
        return n_steps * n_envs

    return loop


def one_by_one(env_id: str, n_envs: int, n_steps: int) -> Loop:
    """Return a loop over the same steps of single copies, one after the other."""
    envs = [make_parallel_env(env_id) for _ in range(n_envs)]
    infos = [env.reset(seed=i)[1] for i, env in enumerate(envs)]
    rng = np.random.default_rng(0)
    everything = np.ones(envs[0].action_space(envs[0].possible_agents[0]).n, dtype=bool)

    def loop() -> int:
        for _ in range(n_steps):
            for i, env in enumerate(envs):
                masks = np.stack([info.get("action_mask", everything) for info in infos[i].values()])
                chosen = random_actions(masks, rng).tolist()
                infos[i] = env.step(dict(zip(env.possible_agents, chosen, strict=True)))[-1]
                # The batch says at every step who saw whom, too
                env.visibility()
                if not env.agents:
                    infos[i] = env.reset()[1]
        return n_steps * n_envs

    return loop


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("env", help="id of the environment")
    parser.add_argument("--steps", type=int, default=100, help="steps of every copy in each measurement")
    parser.add_argument("--rounds", type=int, default=7, help="measurements of each loop")
    args = parser.parse_args()
    loops: dict[str, Loop] = {}
    for n in SIZES:
        loops[f"{n} copies one by one"] = one_by_one(args.env, n, args.steps)
        loops[f"{n} copies at once"] = batched(args.env, n, args.steps)
    report = Report(args.rounds, quick=False)
    report.title(args.env, "copies in one batch against single copies")
    samples = report.measure(args.env, loops)
    for n in SIZES:
        found = ratio(samples[f"{n} copies at once"], samples[f"{n} copies one by one"])
        report.add_ratio(f"batched_{n}", found, f"{n} copies at once / one by one")


if __name__ == "__main__":
    main()
