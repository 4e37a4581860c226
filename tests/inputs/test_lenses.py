"""Crops: lenses that their EXIF data or the middle of the images do not tell."""

from pathlib import Path

import numpy as np
import pytest
import torch

from tests.inputs.match_database import FOCAL, SIZE, box, floor, orbit, write_database
from vg2gt.geometry.alignment import align_points
from vg2gt.inputs import sfm
from vg2gt.inputs.lenses import Lenses, is_centre_found, with_right_lenses
from vg2gt.inputs.pair_evidence import Matches
from vg2gt.io.colmap import quiet_colmap
from vg2gt.monitor import Monitor

pytest.importorskip("pycolmap")
COUNT = 12
CORNERS = np.array([[90.0, 70], [-90, 70], [-90, -70], [90, -70]])[np.arange(COUNT) % 4]


@pytest.mark.parametrize(
    ("focal", "given", "middles", "said"),
    [
        (FOCAL, FOCAL, np.zeros(2), ""),
        (1000.0, 555.0, np.zeros(2), "EXIF data do not fit"),
        (FOCAL, 0.0, CORNERS[0], "away from the middle"),
        pytest.param(FOCAL, 0.0, CORNERS, "may be wrong", marks=pytest.mark.slow),
    ],
)
def test_crops_get_the_lens_that_fits(
    tmp_path: Path, caplog, focal: float, given: float, middles: np.ndarray, said: str
) -> None:
    poses, names = orbit(COUNT, turn=200), [f"{number:06d}.jpg" for number in range(COUNT)]
    dots, database = box((1, 2, 3, 4)).joined(floor()), tmp_path / "database.db"

    def mapped(lenses: Lenses, centre: bool):
        database.unlink(missing_ok=True)
        known = max(next(iter(lenses))[2], 0)
        write_database(database, poses, dots, lens=(focal, middles), given=known, own=len(lenses) > 1)
        return Matches.read(database), sfm._map(tmp_path, COUNT, Monitor(), centre)

    (tmp_path / "images").mkdir()
    with quiet_colmap():
        _, models = with_right_lenses(database, {(*SIZE, given): names}, mapped)
    assert caplog.text.count("WARNING") == (said != "")
    assert said in caplog.text
    assert is_centre_found(models[0]) == ("away" in said)
    placed = {image.name: image.projection_center() for image in models[0].images.values()}
    assert sorted(placed) == names
    found, true = (torch.tensor(np.stack(each))[None] for each in ([placed[name] for name in names], _centers(poses)))
    off = (align_points(found, true).apply(found) - true).norm(dim=-1)
    assert off.median() < 0.02 * true.norm(dim=-1).mean()


def test_lenses_that_fail_leave_what_was_found(tmp_path: Path) -> None:
    poses, names = orbit(COUNT, turn=200), [f"{number:06d}.jpg" for number in range(COUNT)]
    database = tmp_path / "database.db"

    def mapped(lenses: Lenses, centre: bool):
        known = max(next(iter(lenses))[2], 0)
        database.unlink(missing_ok=True)
        if not known:
            raise ValueError("no features")
        write_database(database, poses, box((1, 2, 3, 4)).joined(floor()), lens=(1000.0, np.zeros(2)), given=known)
        return Matches.read(database), []

    with quiet_colmap():
        _, models = with_right_lenses(database, {(*SIZE, 555.0): names}, mapped)
    assert models == []
    assert sorted(Matches.read(database).sizes) == names


def _centers(poses: np.ndarray) -> list[np.ndarray]:
    return [np.linalg.inv(pose)[:3, 3] for pose in poses]
