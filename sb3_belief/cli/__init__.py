"""
The command line: a file for each command, with its flags and what it does.

The commands import what they need when they run: torch and Stable-Baselines3 take seconds, which ``--help`` should not.
"""
