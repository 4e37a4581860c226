"""Long captures: views in windows, so that memory does not grow with their number (``docs/guides/long.md``)."""
