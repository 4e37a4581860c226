"""Training: the Lightning module, the run around it, callbacks."""
