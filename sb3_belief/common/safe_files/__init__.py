"""
Files as data: archives whose contents are checked, models without pickles, and whom a file is trusted to name.

A saved model is Stable-Baselines3's zip, which it loads itself, and beside what it pickles there the same as plain data, from
which this package loads it.
"""
