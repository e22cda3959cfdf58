"""
Environments of other packages as a team needs them: one module per family.

A module has ``make(name, **env_kwargs)``, which returns one copy as a PettingZoo ``ParallelEnv``, and ``names()``. It imports
its package inside of functions only, so that looking at the registry needs none of them.
"""
