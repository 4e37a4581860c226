"""Recipe for furnished rooms made with Infinigen."""
