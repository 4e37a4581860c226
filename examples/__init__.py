"""Example plug-ins and scripts; run from a checkout, not part of the installed package."""
