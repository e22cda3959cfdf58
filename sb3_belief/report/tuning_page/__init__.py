"""The page of a tuning: what was searched, the best settings, and all trials."""
