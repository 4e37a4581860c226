"""Frozen visual foundation models with a common interface."""
