"""Geometry in OpenCV conventions (see docs/conventions.md)."""
