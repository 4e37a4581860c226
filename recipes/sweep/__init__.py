"""Recipe for the shipped weights of the plane-sweep backbone: scenes, augmentation, objective and training."""
