"""The page that compares the runs of a study, or of a folder of runs, and the page of each run."""
