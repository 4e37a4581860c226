"""Structure from motion of many photographs, of parts, of copies, and of what cannot be solved."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from tests.data.sources.layouts import pixels
from vg2gt.geometry.alignment import align_points
from vg2gt.geometry.cameras import camera_centers
from vg2gt.inputs import likely_pairs, sfm
from vg2gt.inputs.given_cameras import given_pictures
from vg2gt.inputs.inputs import load_views
from vg2gt.inputs.pictures import Picture, find_pictures
from vg2gt.io import colmap_from_views, write_colmap
from vg2gt.monitor import Monitor
from vg2gt.types import Cameras

PLACES = 40


def office_photos(shared: Path, count: int) -> list[Path]:
    return sorted((shared / "data" / "hololens_office_a" / "images").iterdir())[:count]


def center_errors(pictures: list[Picture], shared: Path, rows: list[int]) -> torch.Tensor:
    """Distances of found to recorded centres, after one similarity, as shares of the path's extent."""
    views = load_views(pictures, (56, 84), Monitor())
    poses = np.linalg.inv(np.loadtxt(shared / "data" / "hololens_office_a" / "poses.txt").reshape(-1, 4, 4)[rows])
    true = Cameras(torch.from_numpy(poses)[None].float(), views.hints.cameras.intrinsics, (56, 84))
    found, known = camera_centers(views.hints.cameras), camera_centers(true)
    errors = (align_points(found, known).apply(found) - known).norm(dim=-1)[0]
    return errors / torch.cdist(known, known).max()


def test_pairs_of_many_are_neighbours_and_those_that_look_alike() -> None:
    """Two walks past the same places: each image shows two of them, in another light the second time."""
    rng = np.random.default_rng(0)
    places = rng.integers(0, 100, (PLACES + 1, 30, 128))
    shown = [np.concatenate((places[i % PLACES], places[i % PLACES + 1])) for i in range(2 * PLACES)]
    descriptors = [(rows + rng.integers(0, 20, rows.shape)).astype(np.uint8) for rows in shown]
    pairs = likely_pairs.likely_pairs(descriptors)
    assert all(0 <= before < later < 2 * PLACES for before, later in pairs)
    assert len(set(pairs)) == len(pairs) <= 2 * PLACES * (len(likely_pairs.DISTANCES) + likely_pairs.ALIKE)
    assert {(i, i + step) for step in (1, 2, 4, 8, 16) for i in range(2 * PLACES - step)} <= set(pairs)
    assert {(i, i + PLACES) for i in range(PLACES)} <= set(pairs)
    assert likely_pairs.likely_pairs(descriptors) == pairs


def test_many_photographs_are_matched_in_likely_pairs(shared: Path, tmp_path: Path, monkeypatch) -> None:
    """The way of many, for eight: 17 of 28 pairs."""
    pycolmap = pytest.importorskip("pycolmap")
    pairs: list[str] = []
    match = pycolmap.match_image_pairs

    def count(database: Path, **options: Any) -> None:
        pairs.extend(options["pairing_options"].match_list_path.read_text().splitlines())
        match(database, **options)

    monkeypatch.setattr(sfm, "ALL_PAIRS", 5)
    monkeypatch.setattr(likely_pairs, "ALIKE", 0)
    monkeypatch.setattr(pycolmap, "match_image_pairs", count)
    pictures = sfm.find_cameras(find_pictures(office_photos(shared, 8)), tmp_path / "sfm", Monitor())
    assert (len(pictures), len(pairs)) == (8, 7 + 6 + 4)
    assert center_errors(pictures, shared, list(range(8))).median() < 0.03


def test_parts_are_named(photos: Path, tmp_path: Path, monkeypatch, caplog) -> None:
    """By a finished folder of four photographs, of which three were placed."""
    kept, names = tmp_path / "sfm", [picture.name for picture in find_pictures(photos)]
    images = {f"{number:06d}.jpg": name for number, name in enumerate(names[:3])}
    model = [f"sparse/{part}.bin" for part in ("cameras", "images", "points3D")]
    for file in (*model, *(f"images/{name}" for name in images)):
        (kept / file).parent.mkdir(parents=True, exist_ok=True)
        (kept / file).touch()
    state = {"key": sfm._key(find_pictures(photos)), "images": images}
    (kept / "sfm.json").write_text(json.dumps(state | {"left_out": names[3:], "other_parts": [names[3:]]}))
    monkeypatch.setattr(sfm, "_solve", lambda *_: pytest.fail("computed again"))
    monkeypatch.setattr(sfm, "recording_pictures", lambda _: [])
    sfm.find_cameras(find_pictures(photos), kept, Monitor())
    assert "1 of 4 images overlap too little with the others" in caplog.text
    assert "1 of them form a separate part with no overlap with the 3 images used" in caplog.text
    assert "reconstruct that part separately: IMG_11" in caplog.text
    assert "look alike" not in caplog.text
    (kept / "sfm.json").write_text(json.dumps(state | {"left_out": names[3:], "folded": 4}))
    sfm.find_cameras(find_pictures(photos), kept, Monitor())
    assert "sides of the scene look alike: with matches between them, which are removed, 4 images" in caplog.text


def test_the_largest_model_with_points_comes_first(tmp_path: Path, monkeypatch) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    empty, small, large = (
        SimpleNamespace(num_points3D=lambda points=points: points, num_reg_images=lambda placed=placed: placed)
        for points, placed in ((0, 8), (500, 2), (90, 3))
    )
    for folder, models, taken in (("a", [empty, small, large], [large, small]), ("b", [empty], [])):
        monkeypatch.setattr(pycolmap, "incremental_mapping", lambda *_, m=models, **__: dict(enumerate(m)))
        (tmp_path / folder).mkdir()
        assert sfm._map(tmp_path / folder, 8, Monitor()) == taken


def test_parts_share_no_image() -> None:
    """Capital letters are images without a camera."""
    models = [
        SimpleNamespace(images={name: SimpleNamespace(name=name, has_pose=name.islower()) for name in names})
        for names in ("abcD", "cdxyZ", "yz", "ab")
    ]
    found = sfm._parts(models)  # pyright: ignore[reportArgumentType]
    assert found == [{"a", "b", "c"}, {"d", "x", "y"}, {"z"}, set()]


def test_small_images_are_doubled_before_features_are_searched():
    small, large = 1199, 4000
    assert sfm.feature_settings([large] * 24) == (1600, 4096, 0)
    assert sfm.feature_settings([large] * 23 + [small]) == (1280, 4096, -1)
    assert sfm.feature_settings([large] * 300) == (1600, 2048, 0)
    assert sfm.feature_settings([small] * 300) == (1024, 2048, -1)


def test_a_kept_folder_has_the_names_of_the_photographs(frames, tmp_path: Path) -> None:
    """``vg2gt reconstruct OUT/sfm``; a damaged list of names is ignored."""
    pytest.importorskip("pycolmap")
    kept, numbers = tmp_path / "sfm", [f"{number:06d}" for number in range(4)]
    (kept / "images").mkdir(parents=True)
    for number, image in zip(numbers, pixels(frames), strict=True):
        Image.fromarray(image).save(kept / "images" / f"{number}.jpg")
    cameras = Cameras(frames.world_to_camera[None].double(), frames.intrinsics[None].double(), (84, 112))
    write_colmap(kept / "sparse", colmap_from_views(cameras, [f"{number}.jpg" for number in numbers]))
    (kept / "sfm.json").write_text(json.dumps({"images": {f"{n}.jpg": f"IMG_{n[-1]}" for n in numbers}}))
    assert [picture.name for picture in given_pictures(kept) or []] == [f"IMG_{number}" for number in range(4)]
    (kept / "sfm.json").write_text("{")
    assert [picture.name for picture in given_pictures(kept) or []] == numbers
