"""
Adapters that turn environments of other packages into PettingZoo environments, one module or package per suite.

Each has ``make(name, **env_kwargs)``, which returns one copy as a ``ParallelEnv``, and ``names()``. It imports its package
inside functions only, so that looking up an id needs none of the packages.
"""
