"""How the shipped weights of the plane-sweep backbone are made: scenes, augmentation, objective, training, scores."""
