"""Freed blocks go back to the system where the commands that train ask for it."""

import ctypes
import subprocess
import sys
from pathlib import Path

import pytest

# glibc raises its threshold to the size of a block that is freed: the next of that size stays in the process.
SECOND_BLOCK = """
import ctypes, os
from vg2gt.cli.allocator import give_back_large_blocks
if {asked}:
    give_back_large_blocks()
class Info(ctypes.Structure):
    _fields_ = [(name, ctypes.c_size_t) for name in "arena ordblks smblks hblks hblkhd a b c d e".split()]
library = ctypes.CDLL(None)
library.malloc.restype, library.mallinfo2.restype = ctypes.c_void_p, Info
library.free.argtypes = [ctypes.c_void_p]
library.free(library.malloc(8 << 20))
before = library.mallinfo2().hblks
library.malloc({size} << 20)
print(library.mallinfo2().hblks - before, os.environ.get("THP_MEM_ALLOC_ENABLE"))
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallinfo2"), reason="needs glibc 2.33 or newer, which can be asked")
@pytest.mark.parametrize(
    ("asked", "size", "environment", "said"),
    [
        (False, 8, {}, "0 None"),
        (True, 8, {}, "1 1"),
        (True, 7, {}, "0 1"),
        (True, 8, {"THP_MEM_ALLOC_ENABLE": "0"}, "1 0"),
        (True, 8, {"MALLOC_MMAP_THRESHOLD_": "33554432"}, "0 None"),
        (True, 2, {"MALLOC_MMAP_THRESHOLD_": "1048576"}, "1 None"),
    ],
)
def test_large_blocks_are_given_back(asked: bool, size: int, environment: dict[str, str], said: str) -> None:
    root = str(Path(__file__).resolve().parents[2])
    code = SECOND_BLOCK.format(asked=asked, size=size)
    environment = {"PATH": "", "PYTHONPATH": root, **environment}
    found = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert found.stdout.strip() == said, found.stderr
