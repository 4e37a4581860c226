"""Evaluation: metrics of single scenes and of data sets, and their report."""
