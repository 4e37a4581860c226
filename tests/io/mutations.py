"""Damaged files."""

from collections.abc import Iterator

import numpy as np


def mutations(content: bytes, count: int, seed: int = 0) -> Iterator[bytes]:
    """``count`` damaged versions: cut short, bits flipped, bytes replaced, pieces removed, repeated or overwritten."""
    rng = np.random.default_rng(seed)
    for i in range(count):
        data = np.frombuffer(content, np.uint8).copy()
        at = int(rng.integers(len(data)))
        length = int(rng.integers(1, 64))
        kind = i % 6
        if kind == 0:
            data = data[:at]
        elif kind == 1:
            where = rng.integers(len(data), size=int(rng.integers(1, 9)))
            data[where] ^= (1 << rng.integers(8, size=len(where))).astype(np.uint8)
        elif kind == 2:
            head = min(len(data), 256)  # headers and counts
            where = rng.integers(head, size=int(rng.integers(1, 5)))
            data[where] = rng.integers(256, size=len(where))
        elif kind == 3:
            data = np.concatenate((data[:at], data[at + length :]))
        elif kind == 4:
            data = np.concatenate((data[:at], data[at : at + length], data[at:]))
        else:
            data[at : at + length] = rng.choice([0, 255, int(rng.integers(256))])
        yield data.tobytes()
