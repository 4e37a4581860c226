"""How shipped weights are made; run from a checkout, not part of the installed package."""
