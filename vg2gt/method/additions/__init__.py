"""This project's additions to the paper's method; each can be switched off (docs/concepts/deviations.md lists them)."""
