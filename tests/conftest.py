"""Settings of all tests."""

import multiprocessing
import signal

import torch as th

from sb3_belief.common.processes import WORKERS_NEED

# The networks are small, and results must not depend on the machine's cores
th.set_num_threads(1)
# Under nohup this process would ignore the signal, and so would those that tests start and send it to
if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
# Worker processes start from a server that has imported what they need: a tenth of a second each instead of seconds
multiprocessing.set_forkserver_preload(
    [*WORKERS_NEED, "tests.team.toy_envs", "tests.zoo.interrupted", "sb3_belief.zoo.train", "mpe2.simple_spread_v3"]
)
