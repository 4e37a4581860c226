"""Reconstruction of scenes from images, all at once or in windows."""
