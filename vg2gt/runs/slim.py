"""``python -m vg2gt.runs.slim RUN FILE.safetensors``: a run's trained weights without what only training needs."""

from __future__ import annotations

import sys

from vg2gt.runs.checkpoints import write_slim
from vg2gt.runs.find import checkpoint_path

if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    found = checkpoint_path(sys.argv[1])
    assert found is not None
    print(write_slim(found, sys.argv[2]))
