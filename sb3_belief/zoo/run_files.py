"""Where the teams are in the folder of a run."""

#: The team as it was at the end
TEAM = "team.zip"
#: The team of the best evaluation
BEST_MODEL = "best_model.zip"
#: Folder of the checkpoints
CHECKPOINTS = "checkpoints"
