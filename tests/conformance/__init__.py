"""
The test suites that ship with stable-baselines3 and sb3-contrib, sat by our algorithms in place of PPO and MaskablePPO.

`fetch` gets the suites of the installed versions into a folder that git ignores, `run` runs them, `plugin` is what pytest
loads into each run: it puts our classes in place of theirs, selects the tests that these take part in, and knows the tests
listed in `listed.yml` as not applicable.
"""
