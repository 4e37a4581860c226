"""What this project adds to the paper's method; each can be switched off (docs/paper.md lists them)."""
