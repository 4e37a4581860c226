"""What this project adds to the paper's method; each can be switched off (docs/concepts/method.md lists them)."""
