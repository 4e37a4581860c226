"""Runs on disk: found, trusted, loaded; their checkpoints."""
