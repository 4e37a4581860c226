"""Recipes for the shipped weights; run from a checkout, not part of the installed package."""
