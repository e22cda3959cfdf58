"""Folders of studies and of runs, written without any training."""

import json

import numpy as np
import pyarrow as pa
import yaml

from sb3_belief.report.episodes import EPISODES, write_episodes_table

VERSIONS = {"python": "3.11.7", "sb3-belief": "0.1.0", "stable-baselines3": "2.9.2", "torch": "2.13.0"}
HEADER = '#{"t_start": 0.0, "env_id": "Team"}\nr,l,t,is_success\n'
ERROR = 'Traceback (most recent call last):\n  File "<lost>", line 1\nValueError: </script> & <b>no memory</b>'


def write_evaluations(folder, steps, returns, successes=None, length=5):
    """Write the file of a run's evaluations as SB3 does."""
    known = {} if successes is None else {"successes": successes}
    lengths = np.full(np.shape(returns), length)
    np.savez(folder / "evaluations.npz", timesteps=steps, results=returns, ep_lengths=lengths, **known)


def write_run(folder, algo, env, seed, chances, status="finished", settings=None, episodes=8, beliefs=False, **record):
    """
    Write the folder of a run that was evaluated each 1,000 joint steps.

    :param chances: Chance of success at each evaluation
    """
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True)
    steps = 1000 * np.arange(1, len(chances) + 1)
    won = rng.random((len(chances), episodes)) < np.array(chances)[:, None]
    write_evaluations(folder, steps, won * 2.0 - 1, won, length=20)
    rows = "".join(f"{2.0 * (rng.random() < chance) - 1},200,0.1,True\n" for chance in chances for _ in range(5))
    (folder / "monitor.csv").write_text(HEADER + rows)
    (folder / "config.yml").write_text(yaml.safe_dump({env: {"n_timesteps": int(steps[-1]), **(settings or {})}}))
    content = {
        "status": status,
        "algo": algo,
        "env": env,
        "seed": seed,
        "start_timesteps": 0,
        "total_timesteps": int(steps[-1]),
        "options": {"eval_freq": 1000, "eval_episodes": episodes},
        "command": f"sb3-belief train --algo {algo} --env {env} --seed {seed}",
        "started": f"2026-01-0{seed + 1}T12:00:00+0000",
        "versions": VERSIONS,
        "seconds": 12.5,
        "timesteps": int(steps[-1]),
        **record,
    }
    (folder / "run.json").write_text(json.dumps(content))
    if beliefs:
        for agent in ("car_0", "car_1"):
            path = folder / "agents" / agent
            path.mkdir(parents=True)
            lines = [
                f"{step},{0.4 + 0.3 * step / steps[-1] + 0.02 * rng.standard_normal():.4f},{0.1 * i:.3f},"
                for i, step in enumerate(steps)
            ]
            (path / "progress.csv").write_text(
                "time/total_timesteps,belief/accuracy,belief/fusion_ratio,train/loss\n" + "\n".join(lines) + "\n"
            )
    return folder


def write_study(folder, arms, environments, n_seeds=5, n_evaluations=8, episodes=32, final_episodes=64, **keys):
    """
    Write the folder of a study whose runs have finished.

    :param arms: {arm: (algorithm, chance of success at the end)}
    """
    folder.mkdir(parents=True)
    specification = {
        "name": folder.name,
        "environments": {env: {} for env in environments},
        "algorithms": {arm: {"algo": algo} for arm, (algo, _) in arms.items()},
        "seeds": list(range(n_seeds)),
        "evaluation": {"every": 1000, "episodes": episodes, "copies": 8, "final_episodes": final_episodes},
        "baseline": next(iter(arms)),
        **keys,
    }
    (folder / "study.yml").write_text(yaml.safe_dump(specification, sort_keys=False))
    for env in environments:
        for arm, (algo, chance) in arms.items():
            for seed in range(n_seeds):
                write_cell(folder, arm, algo, env, seed, chance, n_evaluations, episodes, final_episodes)
    return folder


def cell_folder(folder, arm, env, seed):
    return folder / "cells" / arm / env.replace("/", "-") / f"seed_{seed}"


def write_cell(folder, arm, algo, env, seed, chance, n_evaluations, episodes, final_episodes):
    rng = np.random.default_rng([seed, len(arm), len(env)])
    cell = cell_folder(folder, arm, env, seed)
    own = chance + 0.05 * rng.standard_normal()
    chances = own * (1 - np.exp(-np.arange(1, n_evaluations + 1) / 2))
    run = cell / algo / f"{env.replace('/', '-')}_1"
    write_run(run, algo, env, seed, chances, episodes=episodes, beliefs="belief" in algo)
    common = {"study": folder.name, "arm": arm, "algorithm": algo, "environment": env, "seed": seed}
    rows = []

    def add(phase, checkpoint, deterministic, steps, chance, number):
        for episode, won in enumerate(rng.random(number) < chance):
            kind = {"phase": phase, "checkpoint": checkpoint, "deterministic": deterministic, "joint_steps": int(steps)}
            scores = {"episode": episode, "episode_return": 2.0 * won - 1, "success": float(won), "length": 20}
            rows.append({**common, **kind, **scores})

    for index, each in enumerate(chances):
        add("training", "current", True, 1000 * (index + 1), each, episodes)
    for checkpoint in ("last", "best"):
        for deterministic in (True, False):
            add("final", checkpoint, deterministic, 1000 * n_evaluations, own, final_episodes)
    write_episodes_table(pa.Table.from_pylist(rows, schema=EPISODES), cell / "episodes.parquet")
    write_cell_record(cell, arm=arm, algo=algo, env=env, seed=seed, status="finished")


def write_cell_record(cell, **record):
    cell.mkdir(parents=True, exist_ok=True)
    (cell / "cell.json").write_text(json.dumps({"attempts": 1, "error": None, "seconds": 30.0, "cpu_seconds": 28.0, **record}))
