"""Long captures: views are processed in windows, to bound memory (``docs/guides/long.md``)."""

WINDOWS = "windows"  # subfolder of the output folder that keeps them
