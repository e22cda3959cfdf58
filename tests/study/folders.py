"""Folders of studies and of runs, written without any training."""

import csv
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


SEARCH = {
    "learning_rate": {"low": 1e-4, "high": 1e-2, "log": True, "schedule": "linear"},
    "n_epochs": {"low": 2, "high": 10},
    "gamma": {"low": 0.5, "high": 1.0},
    "belief": {"choices": ["dynamic", "static"]},
    "policy_kwargs.net_arch": {"choices": [[8], [16, 16]]},
}


def write_tuning(folder, n_trials=12, n_seeds=2, n_evaluations=4, **keys):
    """
    Write the folder of a tuning as ``sb3-belief tune`` does.

    Trial 3 is pruned, 5 failed, 6 was killed and is repeated by 7, and the last one is running. The best one is 4.
    """
    rng = np.random.default_rng(0)
    folder.mkdir(parents=True)
    specification = {
        "name": folder.name,
        "algo": "belief_ppo",
        "env": "junction",
        "n_timesteps": 1000 * n_evaluations,
        "n_trials": max(n_trials - 1, 1),
        "seeds": list(range(1000, 1000 + n_seeds)),
        "last_evaluations": 2,
        "evaluation": {"every": 1000, "episodes": 8, "copies": 2},
        "search": SEARCH,
        **keys,
    }
    (folder / "tune.yml").write_text(yaml.safe_dump(specification, sort_keys=False))
    names = ["trial", "state", "objective", "value", "seed_values", "evaluations", "repeats", "started", "seconds", "error"]
    with open(folder / "trials.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [*names, *(f"search/{name}" for name in SEARCH)], lineterminator="\n")
        writer.writeheader()
        for number in range(n_trials):
            state = {3: "pruned", 5: "failed", 6: "killed", n_trials - 1: "running"}.get(number, "complete")
            row = {
                "trial": number,
                "state": state,
                "objective": "return",
                "started": "2026-01-01T12:00:00",
                "search/learning_rate": f"lin_{10 ** rng.uniform(-4, -2)!r}",
                "search/n_epochs": int(rng.integers(2, 11)),
                "search/gamma": float(rng.uniform(0.5, 1)),
                "search/belief": ["dynamic", "static"][number % 2],
                "search/policy_kwargs.net_arch": ["[8]", "[16, 16]"][number // 2 % 2],
            }
            rise = np.arange(1, n_evaluations + 1) * (2.0 if number == 4 else rng.uniform(0, 1))
            runs = [rise + rng.normal(0, 0.1, n_evaluations) for _ in range(n_seeds)]
            if state == "complete":
                scores = [float(run[-2:].mean()) for run in runs]
                row.update(value=float(np.mean(scores)), seed_values=json.dumps(scores), seconds=12.5 + number)
                row.update(evaluations=json.dumps(np.concatenate(runs).tolist()), repeats=6 if number == 7 else "")
            elif state == "pruned":
                row.update(
                    value=float(runs[0][1]), seed_values="[]", evaluations=json.dumps(runs[0][:2].tolist()), seconds=3.1
                )
            else:
                row.update(seed_values="[]", evaluations="[]")
                row["error"] = {"failed": "no memory </script> & <b>x</b>", "killed": "its process was killed"}.get(state, "")
            writer.writerow(row)
    (folder / "best.yml").write_text("# Settings of trial 4\njunction:\n  n_epochs: 3\n  learning_rate: lin_0.001\n")
    return folder
