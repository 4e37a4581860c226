"""Damaged files, and the check that a reader answers them with its documented error only."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from vg2gt.io import FormatError

SECONDS = 20.0  # a hang, on the slowest machine; a damaged small file takes milliseconds


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


def survives(read: Callable[[], object], path: Path, count: int, seed: int = 0) -> int:
    """Damages ``path`` in turn and reads; any other exception than the documented one escapes."""
    content = path.read_bytes()
    refused = 0
    for damaged in mutations(content, count, seed):
        path.write_bytes(damaged)
        begin = time.monotonic()
        message = None
        try:
            read()
        except FormatError as error:
            message = str(error)
        refused += message is not None
        assert message is None or path.parent.name in message  # it names the file or its folder
        assert time.monotonic() - begin < SECONDS
    path.write_bytes(content)
    return refused
