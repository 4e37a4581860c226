"""Reconstruction of scenes from images, and their export to files."""
