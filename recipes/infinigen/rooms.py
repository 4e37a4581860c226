"""Which rooms there are: a seed decides the kind of room and whether it is held out of training."""

from __future__ import annotations

# Infinigen's name of a kind, and how the names of its floors begin.
KINDS = {
    "DiningRoom": "dining-room",
    "LivingRoom": "living-room",
    "Bedroom": "bedroom",
    "Kitchen": "kitchen",
    "Bathroom": "bathroom",
}
HELD_OUT = (3, 7, 10, 14, 16, 20, 24, 28, 32, 36)
"""Seeds that no training may see: two rooms of each kind, among the first forty."""


def kind(seed: int) -> str:
    """Infinigen's name of the kind of room that a seed makes; the kinds take turns."""
    return list(KINDS)[seed % len(KINDS)]


def name(seed: int) -> str:
    """Folder of a room."""
    return f"room_{seed:04d}"


def part(seed: int) -> str:
    """Folder of a room's split."""
    return "held_out" if seed in HELD_OUT else "train"
