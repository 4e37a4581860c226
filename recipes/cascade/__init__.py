"""Recipe for the weights of the cascade plane sweep: samples, objective and training."""
