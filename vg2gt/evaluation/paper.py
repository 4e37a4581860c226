"""The paper's tables (``paper_tables.json``), used only to print them next to our results."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from vg2gt.io.files import read_json

_TABLES = Path(__file__).resolve().parent / "paper_tables.json"
OURS = "VG2GT"
MODES = {OURS: "solid", f"{OURS}(3DGS)": "rasterized"}  # rows of the paper -> rendering mode
_RESOLUTION = (518, 518)
_ALIGNMENT = "median"
SOURCES = {  # data sets of the paper -> classes that read them
    "replica": ("Replica",),
    "dtu": ("DTU",),
    "tat": ("TanksAndTemples",),
    "scannet": ("ScanNet", "ScanNetSens"),
}

DEPTH, IMAGES, DECODED = "tbl_depth_whole", "tbl_nvs_whole", "tbl_depth_scannet_tat"
NORMALS, UNIFORMITY = "tbl_camera_orientation", "tbl_point_uniformity"


@lru_cache(maxsize=1)
def tables() -> Mapping[str, Any]:
    """The tables as ``{LaTeX label: {data set: {method: metrics}}}``; some have metrics per number of views."""
    return read_json(_TABLES)


def obstacle(dataset: str, settings: Mapping[str, Any]) -> str | None:
    """Returns why results cannot be compared with the paper's rows on a data set; None if they can.

    Args:
        dataset: name in the tables, such as ``replica``.
        settings: ``data`` (name of the class that reads it), ``size`` of the images, ``alignment`` and
            ``depth_range`` of an evaluation's report, and whether the backbone is ``told`` the data's depth or cameras.
    """
    size, alignment = settings["size"], settings["alignment"]
    if settings["data"] not in SOURCES.get(dataset, ()):
        return f"the data is read by {settings['data']}, which is not the paper's {dataset}"
    if tuple(size) != _RESOLUTION:
        return f"images are {size[0]}x{size[1]}, the paper's 518x518"
    if alignment != _ALIGNMENT or any(bound is not None for bound in settings["depth_range"]):
        return (
            f"depth is aligned by {alignment} within {settings['depth_range']}, the paper's by {_ALIGNMENT} without "
            "bounds"
        )
    return "the backbone is given true depth or cameras" if settings["told"] else None


def rows_by_views(table: str, dataset: str | None, views: int) -> Iterator[tuple[str, Mapping[str, float]]]:
    """Yields rendering mode and metrics of the paper's method for a number of views; nothing without a data set."""
    methods = tables()[table].get(dataset, {})
    for method, mode in MODES.items():
        if str(views) in methods.get(method, {}):
            yield mode, methods[method][str(views)]


def row(table: str, dataset: str | None, method: str = OURS) -> Mapping[str, float] | None:
    """A method's row in a table without numbers of views; None if the table lacks the data set or the method."""
    return tables()[table].get(dataset, {}).get(method)
