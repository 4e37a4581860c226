"""Runs on disk: checkpoints, loading of models, checks of untrusted configurations."""
