"""Datasets on disk, one file a layout; all are a ``FileSource``."""
