"""One thread for every test: the networks are small, and results must not depend on the machine's cores."""

import torch as th

th.set_num_threads(1)
