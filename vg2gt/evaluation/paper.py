"""The paper's tables (``paper_tables.json``), to be printed beside our figures and for nothing else."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from vg2gt.io.files import read_json

TABLES = Path(__file__).resolve().parent / "paper_tables.json"
OURS = "VG2GT"
MODES = {OURS: "solid", f"{OURS}(3DGS)": "rasterized"}  # the paper's rows and how they are rendered
RESOLUTION = (518, 518)
ALIGNMENT = "median"

DEPTH, IMAGES, DECODED = "tbl_depth_whole", "tbl_nvs_whole", "tbl_depth_scannet_tat"
NORMALS, UNIFORMITY = "tbl_camera_orientation", "tbl_point_uniformity"


@lru_cache(maxsize=1)
def tables() -> Mapping[str, Any]:
    """Table (its LaTeX label) -> data set -> method -> figures, in some tables by number of views."""
    return read_json(TABLES)


def is_the_papers(dataset: str | None, size: tuple[int, int], alignment: str) -> bool:
    """Whether figures may stand beside the paper's: its data set, its resolution, its alignment of depth."""
    return dataset is not None and tuple(size) == RESOLUTION and alignment == ALIGNMENT


def rows_by_views(table: str, dataset: str, views: int) -> Iterator[tuple[str, Mapping[str, float]]]:
    """The paper's own rows for a number of views: rendering mode and figures."""
    methods = tables()[table].get(dataset, {})
    for method, mode in MODES.items():
        if str(views) in methods.get(method, {}):
            yield mode, methods[method][str(views)]


def row(table: str, dataset: str, method: str = OURS) -> Mapping[str, float] | None:
    """A method's row of a table without numbers of views; None if the data set is not in it."""
    return tables()[table].get(dataset, {}).get(method)
