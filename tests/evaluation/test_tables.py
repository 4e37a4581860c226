import re
from pathlib import Path
from typing import Any

import pytest

from vg2gt.evaluation import paper
from vg2gt.evaluation.sections import report_markdown


def report(**settings: Any) -> dict[str, Any]:
    scores = {
        "rendered/gt_pose/solid/abs_rel": 0.0123,
        "rendered/gt_pose/solid/coverage": 0.9876,
        "rendered/gt_pose/solid/psnr": 25.5,
        "rendered/gt_pose/rasterized/abs_rel": None,
        "rendered/gt_pose/rasterized/psnr": 24.0,
        "rendered/gt_pose/solid/normal_mean": 12.3,
        "decoded/after/abs_rel": 0.01,
        "scene/cv": 0.25,
    }
    known = {
        "name": "test", "weights": "none", "model": "VG2GT", "backend": {"name": "oracle", "weights": "0a" * 32},
        "data": "Rooms", "scenes": 1, "index": "replica", "size": [518, 518], "alignment": "median",
        "depth_range": [None, None], "neighbors": 8, "lpips": "VGG-16, version 0.1", "device": "cpu",
        "points": {"threshold": 0.05, "cap": None}, "paper": None, "paper_obstacle": None,
    }  # fmt: skip
    views = {str(count): {"mean": scores, "scenes": {"room": scores}} for count in (3, 10)}
    return {"settings": known | settings, "views": views}


def test_figures_stand_where_they_belong() -> None:
    text = report_markdown(report())
    assert re.search(r"\| 3 +\| gt_pose +\| solid +\| +0\.0123 \|.* 0\.9876 \|", text)
    assert re.search(r"\| 10 +\| gt_pose +\| rasterized \| +24\.00 \| +n/a \| +n/a \|", text)
    assert re.search(r"\| room +\| 3 +\| +25\.50 \|", text)
    assert "alignment median, true depths from 0 to any" in text
    assert "threshold 0.05, cap None" in text
    assert "k = 8" in text
    assert "## Cameras of the input views\n\nn/a" in text
    assert "paper" not in text


def test_the_papers_rows_stand_beside_ours() -> None:
    text = report_markdown(report(paper="replica"))
    assert re.search(r"\| 3 +\| paper, tbl_depth_whole +\| solid +\| +0\.0070 \| +n/a \| +0\.0690 \|", text)
    assert re.search(r"\| 10 +\| paper, tbl_depth_whole +\| rasterized \| +0\.0140 \|", text)
    assert re.search(r"\| 3 +\| paper, tbl_nvs_whole +\| solid +\| +31\.03 \| +0\.898 \| +0\.169 \|", text)
    assert re.search(r"paper, tbl_camera_orientation +\| solid +\| +7\.34 \| +3\.64 \|", text)
    assert re.search(r"paper, tbl_point_uniformity +\| +0\.353 \|", text)
    enhanced = report_markdown(report(paper="scannet"))
    assert re.search(r"after: paper, tbl_depth_scannet_tat +\| +0\.0320 \|", enhanced)
    assert re.search(r"before \(DA3\): paper, tbl_depth_scannet_tat +\| +0\.0360 \|", enhanced)
    assert "tbl_depth_whole" not in enhanced


PAPERS = {"data": "Replica", "size": (518, 518), "alignment": "median", "depth_range": [None, None], "told": False}


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("data", "SyntheticScenes", "read by SyntheticScenes, which is not the paper's replica"),
        ("data", "ScanNet", "read by ScanNet"),
        ("size", (112, 224), "images are 112x224"),
        ("alignment", "none", "aligned by none"),
        ("depth_range", [None, 10], r"within \[None, 10\]"),
        ("told", True, "given true depth"),
    ],
)
def test_only_the_papers_protocol_may_stand_beside_the_paper(key: str, value: Any, told: str) -> None:
    assert paper.obstacle("replica", PAPERS) is None
    assert re.search(told, paper.obstacle("replica", PAPERS | {key: value}) or "")
    assert "the paper's rows are left out: because" in report_markdown(report(paper_obstacle="because"))


def figures(node: Any) -> list[float]:
    if isinstance(node, dict):
        return [value for child in node.values() for value in figures(child)]
    return [node] if isinstance(node, float) else []


@pytest.mark.parametrize("label", sorted(paper.tables()))
def test_the_tables_hold_the_papers_figures_in_its_order(label: str, shared: Path) -> None:
    text = (shared / "paper" / "vg2gt.tex").read_text()
    end = text.index("\\label{" + label + "}")
    table = text[text.rfind("\\begin{table", 0, end) : end]
    body = [line for line in table.splitlines() if "&" in line and "Views" not in line]
    cells = [
        re.sub(r"\\textbf\{|\}|\{", "", cell).strip() for line in body for cell in line.split("\\\\")[0].split("&")
    ]
    printed = [float(cell) for cell in cells if re.fullmatch(r"\d+(\.\d+)?", cell)]
    assert len(printed) > 3
    assert figures(paper.tables()[label]) == printed
