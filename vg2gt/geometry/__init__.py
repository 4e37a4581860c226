"""Geometry in OpenCV conventions (see docs/concepts/conventions.md)."""
