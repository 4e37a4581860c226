"""Kind and split of rooms, as determined by their seeds."""

from __future__ import annotations

# Infinigen's name of a kind of room, and prefix of the names of its floors.
KINDS = {
    "DiningRoom": "dining-room",
    "LivingRoom": "living-room",
    "Bedroom": "bedroom",
    "Kitchen": "kitchen",
    "Bathroom": "bathroom",
}
HELD_OUT = (3, 7, 10, 14, 16, 24, 28, 30, 32, 36)
"""Seeds excluded from training: two rooms of each kind among the first forty."""


def kind(seed: int) -> str:
    """Returns Infinigen's name of the kind of room for a seed; kinds alternate."""
    return list(KINDS)[seed % len(KINDS)]


def name(seed: int) -> str:
    """Returns the folder name of a room."""
    return f"room_{seed:04d}"


def part(seed: int) -> str:
    """Returns the folder name of a room's split."""
    return "held_out" if seed in HELD_OUT else "train"
