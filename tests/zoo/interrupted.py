"""
A training that is hit at a known moment.

It runs in a process of its own, which sends the signal to itself, so that it comes exactly then. That process is forked
from the server from which workers start, since it would take longer to import everything than to train.
"""

import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from stable_baselines3 import PPO

import sb3_belief.common.durable_files as durable_files
from sb3_belief.cli.main import train_main
from sb3_belief.zoo.endings import SignalCheck
from sb3_belief.zoo.seeded_evaluation import SeededEvalCallback

MOMENTS = ("rollout", "update", "evaluation", "checkpoint", "end")


def hit(signum, times):
    for i in range(1, times):
        threading.Timer(0.05 * i, os.kill, (os.getpid(), signum)).start()
    os.kill(os.getpid(), signum)


def call_before(owner, name, when, action):
    """Have an action happen once, before the call of a method for which ``when`` is true."""
    real = getattr(owner, name)
    done: list = []

    def wrapper(*args, **kwargs):
        if not done and when(*args, **kwargs):
            done.append(True)
            action()
        return real(*args, **kwargs)

    setattr(owner, name, wrapper)


def prepare(moment, action):
    if moment == "rollout":
        # In the middle of the third rollout
        call_before(SignalCheck, "_on_step", lambda self: self.num_timesteps == 200, action)
    elif moment == "update":
        # The second agent learns for the third time
        call_before(PPO, "train", lambda self: self.num_timesteps == 240 and self._n_updates == 2, action)
    elif moment == "evaluation":
        call_before(SeededEvalCallback, "_log_success_callback", lambda self, *_: self.num_timesteps == 160, action)
    elif moment in ("checkpoint", "end"):
        names: list = []
        done: list = []
        real_open, real_fsync = os.open, os.fsync

        def record_open(path, *args, **kwargs):
            names.append(str(path))
            return real_open(path, *args, **kwargs)

        def fsync(descriptor):
            # The file has been written, and is not in its place yet
            name = "team_160" if moment == "checkpoint" else "/.team.zip"
            if not done and names[-1:] and ".tmp" in names[-1] and name in names[-1]:
                done.append(True)
                action()
            real_fsync(descriptor)

        durable_files.os.open, durable_files.os.fsync = record_open, fsync
    else:
        raise ValueError(moment)


def slow_saves(seconds):
    """Have each save of a file take a while, so that signals come meanwhile."""
    real = os.fsync

    def fsync(descriptor):
        time.sleep(seconds)
        real(descriptor)

    os.fsync = fsync


def run_interrupted(moment, name, words, times=1):
    """
    Run ``train`` in a process of its own that is hit by a signal, and return how it has ended and what it has said.

    :param moment: One of ``MOMENTS``
    :param name: Name of the signal
    :param words: Words of the command line
    :param times: How often the signal comes, 50 ms apart
    """
    with tempfile.TemporaryDirectory() as folder:
        outputs = [Path(folder, each) for each in ("stdout", "stderr")]
        process = multiprocessing.get_context("forkserver").Process(target=_train, args=(moment, name, times, words, outputs))
        process.start()
        process.join()
        assert process.exitcode is not None
        return subprocess.CompletedProcess(words, process.exitcode, *(path.read_text() for path in outputs))


def _train(moment, name, times, words, outputs):
    for path, descriptor in zip(outputs, (1, 2), strict=True):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT), descriptor)
    # A process started in the background may ignore Ctrl-C
    signal.signal(signal.SIGINT, signal.default_int_handler)

    def action():
        if times > 1:
            # The next signals come while the state is saved
            slow_saves(0.3)
        hit(getattr(signal, name), times)

    prepare(moment, action)
    sys.argv[1:] = words
    sys.exit(train_main())
