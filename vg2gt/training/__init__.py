"""Training: the Lightning module, the training run, callbacks."""
