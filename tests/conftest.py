"""Settings of all tests."""

import multiprocessing

import torch as th

# The networks are small, and results must not depend on the machine's cores
th.set_num_threads(1)
# Worker processes start from a server that has imported what they need: a tenth of a second each instead of seconds
multiprocessing.set_forkserver_preload(["tests.team.toy_envs", "sb3_belief.team", "mpe2.simple_spread_v3"])
