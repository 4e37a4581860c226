"""Frozen visual foundation models behind one interface."""
