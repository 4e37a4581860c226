"""Which views of a scene are used: drawn for a training step, spread or drawn for evaluation, or read from an index."""
