"""Helpers of all other packages: random number generators, worker processes, exceptions, versions."""
