"""The Gaussians inside a page, read as its script reads them."""

import base64
import gzip
import json
import math
import re
from pathlib import Path

import numpy as np
import torch

from vg2gt.types import Gaussians
from vg2gt.viewer.packing import SIGNED, UNSIGNED


def read_viewer_html(path: Path) -> Gaussians:
    page = path.read_text()
    content, packed = (re.search(rf'id="{name}">([^<]*)<', page)[1] for name in ("scene", "gaussians"))
    header, data, at = json.loads(content)["gaussians"], gzip.decompress(base64.b64decode(packed, validate=True)), 0

    def take(kind: str, *shape: int) -> torch.Tensor:
        nonlocal at
        column = np.frombuffer(data, kind, math.prod(shape), at)
        at += column.nbytes
        return torch.from_numpy(column.reshape(shape).astype(np.float64))

    count, low = header["count"], header["log_scale_min"]
    means, sh = take("<f4", count, 3), take("<f2", count, (header["degree"] + 1) ** 2, 3)
    scales = (take("<u2", count, 3) / UNSIGNED * (header["log_scale_max"] - low) + low).exp()
    quats, opacities = take("<i2", count, 4) / SIGNED, take("<u2", count) / UNSIGNED
    columns = (column.float() for column in (means, quats, scales, opacities, sh))
    return Gaussians(*columns, torch.zeros(count, dtype=torch.int64))
