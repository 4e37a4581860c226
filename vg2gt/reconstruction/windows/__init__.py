"""Long captures: views are processed in windows, to bound memory (``docs/guides/long.md``)."""
