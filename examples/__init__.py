"""Plug-ins to start from; run from a checkout, not part of the installed package."""
