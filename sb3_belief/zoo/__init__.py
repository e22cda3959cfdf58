"""From a few lines of YAML to a run on disk: training, replaying, and the demo."""
