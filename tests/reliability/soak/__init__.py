"""
Random trainings and random faults, for as long as wanted: ``python -m tests.reliability.soak``.

- ``faults``: what is done to a training
- ``runs``: one run with its faults, and what must hold after each
- ``memory``: a long training of its own that runs alongside
- ``report``: what is counted, and the table of docs/reliability.md
"""
