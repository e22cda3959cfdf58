"""
Loads mutated copies of a saved team and of a saved model, in a process of its own whose memory is measured.

``python -m tests.reliability.fuzz COUNT SEED`` prints what became of them as JSON.
"""

import io
import json
import random
import re
import resource
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import PPO

from sb3_belief import BeliefPPO
from sb3_belief.common.plain_data import encode
from sb3_belief.common.safe_files.models import NamedContent
from sb3_belief.team.checkpoint import read_team, write_team
from tests.archives import archive_of, members_of
from tests.team.helpers import PPO_KWARGS, Team, make_team_env
from tests.team.toy_envs import ToyEnv

NAME = "runs/stranger.zip"


def saved_files() -> tuple[bytes, bytes]:
    """Return the files of a small team, with all kinds of members, and of a single model."""
    th.set_num_threads(1)
    team = Team(PPO, "MlpPolicy", make_team_env(ToyEnv, n_envs=1), seed=0, normalize=True, **PPO_KWARGS).learn(16)
    file = io.BytesIO()
    team.save(file)
    saved = read_team(NamedContent(file.getvalue(), NAME))
    entries = {key: saved.manifest[key] for key in saved.manifest if key not in ("format", "agents", "classes", "versions")}
    file = io.BytesIO()
    parts = {"more": encode({"rng": np.random.default_rng(0), "arrays": [np.arange(100.0)]}, lambda module: False)}
    write_team(file, team.agents, team._agents.statistics, entries, parts)
    small = {**PPO_KWARGS, "policy_kwargs": dict(net_arch=[8], embedding_dim=4, latent_dim=4), "belief": "none"}
    model = BeliefPPO("BeliefPolicy", gym.make("CartPole-v1"), seed=0, **small)
    alone = io.BytesIO()
    model.learn(8).save(alone)
    return file.getvalue(), alone.getvalue()


def _text(value: Any) -> str:
    # Where an object lies in memory says nothing of it
    return re.sub(r"0x[0-9a-fA-F]+", "", str(value))


def of_model(model: Any) -> dict[str, Any]:
    """Return what a loaded model is, as plain values that can be compared."""
    hidden = ("policy", "env", "_logger", "rollout_buffer", "_vec_normalize_env", "start_time")
    settings = {key: _text(value) for key, value in vars(model).items() if key not in hidden}
    weights = {name: value.numpy().tobytes() for name, value in model.policy.state_dict().items()}
    optimiser = str(model.policy.optimizer.state_dict())
    return {"settings": settings, "weights": weights, "optimiser": optimiser}


def of_team(team: Any, parts: Any) -> dict[str, Any]:
    """Return what a loaded team is."""
    statistics = {
        agent: {key: _text(getattr(value, "__dict__", value)) for key, value in vars(each).items()}
        for agent, each in team._agents.statistics.items()
    }
    more = parts.part("more", lambda module: False)
    return {
        "agents": {agent: of_model(model) for agent, model in team.agents.items()},
        "statistics": statistics,
        "team": [team.seed, team.num_timesteps, team.normalize, str(team._scripted)],
        "manifest": parts.manifest,
        "parts": [more["rng"].bit_generator.state, more["arrays"][0].tobytes()],
    }


def load_team(content: bytes) -> dict[str, Any]:
    """Load a team, and return what it is."""
    return of_team(Team.load(NamedContent(content, NAME), device="cpu"), read_team(NamedContent(content, NAME)))


def load_agent(content: bytes) -> dict[str, Any]:
    """Load a model, and return what it is."""
    return of_model(BeliefPPO.load(NamedContent(content, NAME), device="cpu"))


def mutated(content: bytes, rng: random.Random) -> bytes:
    """Return bytes that differ from others in one place or few."""
    if not content:
        return rng.randbytes(rng.randint(1, 20))
    changed = bytearray(content)
    start = rng.randrange(len(changed))
    end = min(len(changed), start + rng.choice([1, 2, 4, 30, 1000, 20_000]))
    kind = rng.randrange(9)
    if kind == 0:
        changed[start] ^= 1 << rng.randrange(8)
    elif kind == 1:
        changed[start] = rng.choice([0, 1, 0x7F, 0x80, 0xFF])
    elif kind == 2:
        del changed[start:end]
    elif kind == 3:
        changed[start:start] = rng.randbytes(end - start)
    elif kind == 4:
        del changed[start:]
    elif kind == 5:
        changed += rng.randbytes(end - start)
    elif kind == 6:
        changed[start:start] = changed[start:end]
    elif kind == 7:
        changed[start:end] = bytes(end - start)
    else:
        # Numbers in the headers of zips
        changed[start : start + 4] = rng.choice([b"\xff\xff\xff\xff", b"\0\0\0\0", b"\xff\xff\xff\x7f", b"PK\1\2"])
    return bytes(changed)


def mutated_inside(content: bytes, rng: random.Random, name: str) -> tuple[bytes, str]:
    """Return a zip of which one member, or a member of a member, is another; all checksums of zips fit, the list does not."""
    members = members_of(content)
    chosen = rng.choice(list(members))
    kind = rng.randrange(8)
    if chosen.endswith((".zip", ".pth")) and kind < 4:
        members[chosen] = mutated_inside(members[chosen], rng, chosen)[0]
    elif kind < 6:
        members[chosen] = mutated(members[chosen], rng)
    elif kind == 6:
        del members[chosen]
    else:
        other = chosen + rng.choice(["x", "/../x", "\\x"])
        members = {(other if key == chosen else key): value for key, value in members.items()}
    return archive_of(members, signed=False), chosen


def mutations(content: bytes, count: int, seed: int) -> Any:
    """Yield mutated copies, each with the member that was changed (None for changes of the outer bytes)."""
    rng = random.Random(seed)
    for index in range(count):
        yield (mutated(content, rng), None) if index % 2 else mutated_inside(content, rng, NAME)


def outcome(load: Callable[[bytes], Any], content: bytes, member: str | None, expected: Any) -> str:
    """Load a mutated file, and say in a word what happened."""
    try:
        found = load(content)
    except ValueError as error:
        text = str(error)
        if NAME not in text:
            return f"does not name the file: {text[:300]}"
        # Two words for what cannot be said better: no list of members is left, or no directory of them
        known = "member" in text or "no team.json" in text or "Stable-Baselines3 alone" in text
        return "refused" if member is None or known else f"does not name {member!r}: {text[:300]}"
    except Exception as error:
        return f"{type(error).__name__}: {str(error)[:300]}"
    return "the same" if found == expected else f"accepted though different ({member})"


def main(count: int, seed: int) -> dict[str, Any]:
    """Load so many mutated files, and count what happened."""
    team, alone = saved_files()
    found: Counter[str] = Counter()
    for load, content, share in ((load_team, team, count * 2 // 3), (load_agent, alone, count - count * 2 // 3)):
        expected = load(content)
        for changed, member in mutations(content, share, seed):
            found[outcome(load, changed, member, expected)] += 1
    return {"outcomes": dict(found), "memory": most_memory()}


def most_memory() -> int:
    """Return the most memory that this process has had, in bytes."""
    try:
        # Unlike getrusage() this does not begin with what the parent had when it started this process
        text = Path("/proc/self/status").read_text()
        return int(text.partition("VmHWM:")[2].split()[0]) * 1024
    except (OSError, IndexError):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


if __name__ == "__main__":
    print(json.dumps(main(int(sys.argv[1]), int(sys.argv[2]))))
