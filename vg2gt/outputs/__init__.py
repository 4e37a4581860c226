"""Writes what a scene consists of, in the formats that other software reads, and reads saved scenes."""
