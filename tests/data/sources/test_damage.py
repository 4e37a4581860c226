"""Every layout with files truncated, altered, exchanged or removed: the documented error, or frames; never a crash.

The plain suite damages each layout a few times; ``pytest -m slow`` does it 250 times.
"""

from pathlib import Path
from shutil import copytree, rmtree

import numpy as np
import pytest
import torch

from vg2gt.data import DataError

from .layouts import Layout, all_layouts, room

LAYOUTS = all_layouts()
PICTURES = (".png", ".jpg", ".jpeg")
NUMBERS = (b"nan", b"inf", b"-1", b"0", b"1e30", b"999999999999", b"word", b"")


@pytest.mark.parametrize("name", LAYOUTS)
def test_damage_is_a_data_error_or_frames(name, tmp_path):
    _damage_often(LAYOUTS[name], tmp_path, range(12))


@pytest.mark.slow
@pytest.mark.parametrize("name", LAYOUTS)
def test_much_damage_is_a_data_error_or_frames(name, tmp_path):
    refused = _damage_often(LAYOUTS[name], tmp_path, range(1000, 1250))
    print(f"{name}: 250 mutations, {refused} refused with the documented error, the others read as frames")


def _damage_often(layout: Layout, folder: Path, seeds: range) -> int:
    whole = folder / "whole"
    layout.write(whole, room())
    refused = 0
    for seed in seeds:
        copy = folder / "damaged"
        copytree(whole, copy)
        what = _damage(copy, np.random.default_rng(seed))
        try:
            _read_all(layout, copy)
        except (DataError, FileNotFoundError) as error:
            refused += 1
            message = str(error)
            if str(copy) not in message and "scene" not in message:
                pytest.fail(f"{what} (seed {seed}): the error names neither file nor scene: {message}")
        except Exception as error:
            pytest.fail(f"{what} (seed {seed}) ended in {type(error).__name__}: {error}")
        rmtree(copy)
    assert refused > 0
    return refused


def _read_all(layout: Layout, folder: Path) -> None:
    source = layout.read(folder)
    for scene in source.scenes:
        ids = source.frames(scene)
        assert len(ids) > 0
        frames = source.load(scene, ids)
        for value in (frames.images, frames.depth, frames.world_to_camera, frames.intrinsics):
            assert len(value) == len(ids)
            assert bool(torch.isfinite(value).all())
        assert bool((frames.depth >= 0).all())
        if source.has_depth:
            assert bool((frames.depth > 0).flatten(1).any(1).all()), "a frame without depth was handed on"


def _damage(folder: Path, rng: np.random.Generator) -> str:
    """Damages one file below ``folder``; returns what was done."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    # Half of the draws go to what is no picture: there are few such files, and they are parsed by our own code.
    others = [path for path in files if path.suffix not in PICTURES]
    chosen = others if others and rng.random() < 0.5 else files
    path = chosen[rng.integers(len(chosen))]
    content = path.read_bytes()
    kind = str(rng.choice(["truncate", "flip", "remove", "noise", "exchange", "number", "lines"]))
    if kind == "truncate":
        path.write_bytes(content[: rng.integers(0, max(1, len(content)))])
    elif kind == "flip":
        damaged = bytearray(content)
        for place in rng.integers(0, max(1, len(content)), 1 + rng.integers(8)):
            damaged[place : place + 1] = bytes([rng.integers(256)])
        path.write_bytes(damaged)
    elif kind == "remove":
        path.unlink()
    elif kind == "noise":
        path.write_bytes(rng.bytes(int(rng.integers(0, 2000))))
    elif kind == "exchange":
        path.write_bytes(files[rng.integers(len(files))].read_bytes())
    elif kind == "number":
        words = content.split(b" ")
        words[rng.integers(len(words))] = NUMBERS[rng.integers(len(NUMBERS))]
        path.write_bytes(b" ".join(words))
    else:
        lines = content.split(b"\n")
        first = int(rng.integers(len(lines)))
        path.write_bytes(b"\n".join(lines[:first] + lines[first + 1 + int(rng.integers(3)) :]))
    return f"{kind} {path.relative_to(folder)}"
