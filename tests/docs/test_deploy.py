"""The service of docs/deploy.md serves an agent, and remembers for it."""

import json
import re
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sb3_belief import BeliefPPO, Team, make_team_env

TEXT = (Path(__file__).parents[2] / "docs" / "deploy.md").read_text(encoding="utf-8")


def saved_follower(folder, belief):
    env = make_team_env("convention-swap", n_envs=2, seed=0, env_kwargs={"m": 3})
    kwargs = {"n_steps": 16, "batch_size": 16, "history_length": 40, "belief": belief}
    team = Team(BeliefPPO, "BeliefPolicy", env, seed=0, **kwargs).learn(32)
    team.save(folder / "team.zip")
    with zipfile.ZipFile(folder / "team.zip") as archive:
        return archive.extract("agents/follower.zip", folder)


@pytest.fixture(params=["dynamic"])
def service(tmp_path, request):
    """A function that asks the running service, and the agent that it serves."""
    (code,) = re.findall(r"```python\n(# python service.py.*?)```", TEXT, re.DOTALL)
    (tmp_path / "service.py").write_text(code)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    agent = saved_follower(tmp_path, request.param)
    process = subprocess.Popen([sys.executable, tmp_path / "service.py", agent, str(port)])

    def ask(path, **body):
        request = urllib.request.Request(f"http://127.0.0.1:{port}/{path}", json.dumps(body).encode())
        for _ in range(900):
            try:
                with urllib.request.urlopen(request) as response:
                    return json.load(response)
            except urllib.error.HTTPError as error:
                return json.load(error)
            except urllib.error.URLError:
                assert process.poll() is None, "the service has ended"
                time.sleep(0.1)
        raise TimeoutError("the service does not answer")

    yield ask, BeliefPPO.load(agent, device="cpu")
    process.terminate()
    process.wait()


def test_it_predicts_and_remembers_as_the_agent_does(service):
    ask, agent = service
    cues = np.arange(3)
    answer = ask("predict", observations=cues.tolist())
    assert answer["actions"] == agent.predict(cues, deterministic=True)[0].tolist()
    np.testing.assert_allclose(answer["others"]["leader"], agent.policy.predict_others(cues).actions["leader"], rtol=1e-5)

    seen = (np.arange(40) % 3).tolist()
    # Two conventions, one of which the untrained follower has not seen yet
    for shift in (1, 2):
        actions = {"leader": [(cue + shift) % 3 for cue in seen]}
        ask("remember", observations=seen, actions=actions)
        agent.policy.remember(np.array(seen), actions)
    after = ask("predict", observations=cues.tolist())
    assert after["others"] != answer["others"]
    np.testing.assert_allclose(after["others"]["leader"], agent.policy.predict_others(cues).actions["leader"], rtol=1e-5)

    assert "'x' is none of the others" in ask("remember", observations=seen, actions={"x": seen})["error"]
    assert ask("predict", observations=cues.tolist()) == after


@pytest.mark.parametrize("service", ["adaptive"], indirect=True)
def test_an_adaptive_agent_is_told_what_it_did_and_got(service):
    ask, agent = service
    cues = np.arange(3)
    answers = []
    told: list[dict[str, Any]] = [
        {"own_actions": [2]},
        {"own_actions": [0], "rewards": [1.0]},
        {"visible": {"leader": [False]}},
    ]
    for step, more in enumerate(told):
        body: dict[str, Any] = {"observations": [step], "actions": {"leader": [step]}}
        ask("remember", **body, **more, episode_ended=step == 1)
        agent.policy.remember(np.array([step]), body["actions"], **more)
        if step == 1:
            agent.policy.end_episodes()
        answers.append(ask("predict", observations=cues.tolist())["others"]["leader"])
        np.testing.assert_allclose(answers[-1], agent.policy.predict_others(cues).actions["leader"], rtol=1e-5)
    assert answers[0] != answers[1]
    assert "own_actions must be" in ask("remember", observations=[0], actions={}, own_actions=[1, 2])["error"]
