"""Studies of several trainings: ablations and comparisons."""
