"""Evaluation: figures of one scene, of data sets, and their report."""
