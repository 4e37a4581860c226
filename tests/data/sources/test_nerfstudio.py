"""Captures with a transforms.json: a real one by geometry, distortion, absent files, cameras that are refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from vg2gt.data import DataError
from vg2gt.data.sources import Nerfstudio
from vg2gt.data.transforms import resize

from .layout_nerfstudio import write
from .layouts import SIZE, room
from .plane_sweep import median_best_ncc


def test_real_capture_by_plane_sweep(shared):
    """The README's 0.96 and 0.91 for a near and a farther pair; read as OpenCV poses it gets clearly worse."""
    source = Nerfstudio(str(shared / "data" / "ingp_fox"))
    (scene,) = source.scenes
    ids = source.frames(scene)
    assert len(ids) == 24
    assert source.scene_index(scene).dropped == {"without a colour image": 43}
    assert not source.is_metric
    frames = resize(source.load(scene, [ids[0], ids[1], ids[3]]), (240, 135))
    opengl = torch.diag(torch.tensor([1.0, -1, -1, 1]))
    misread = replace(frames, world_to_camera=opengl @ frames.world_to_camera)
    near, far, wrong = (
        median_best_ncc(views.map(lambda tensor, other=other: tensor[[0, other]]), 1.5, 15, planes=32)
        for views, other in ((frames, 1), (frames, 2), (misread, 2))
    )
    assert near == pytest.approx(0.96, rel=0.1)
    assert far == pytest.approx(0.91, rel=0.1)
    assert wrong < 0.7


def _edit(folder, change) -> None:
    path = folder / "desk" / "transforms.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def test_distortion_changes_image_depth_and_intrinsics(tmp_path):
    write(tmp_path, room(3))
    plain = Nerfstudio(str(tmp_path), depth=True).load("desk", [0])
    _edit(tmp_path, lambda content: content.update(k1=0.5))
    source = Nerfstudio(str(tmp_path), depth=True)
    loaded = source.load("desk", [0])
    zoom = float(loaded.intrinsics[0, 0, 0] / plain.intrinsics[0, 0, 0])
    assert 1.05 < zoom < 1.5
    # The axis stays where it is; off it, the enlarged image shows what the plain one has nearer to the axis.
    assert float((loaded.images - plain.images).abs().mean()) > 0.01
    assert set(loaded.depth.unique().tolist()) <= set(plain.depth.unique().tolist())
    assert not torch.equal(loaded.depth, plain.depth)


def test_numbers_follow_names_and_absent_files_are_counted(tmp_path):
    write(tmp_path, room(4))
    (tmp_path / "desk" / "images" / "0001.png").unlink()
    _edit(tmp_path, lambda content: content["frames"][0].pop("depth_file_path"))  # the file lists frame 3 first
    source = Nerfstudio(str(tmp_path / "desk"))
    assert tuple(source.frames("desk")) == (0, 2, 3)
    deep = Nerfstudio(str(tmp_path / "desk"), depth=True)
    assert tuple(deep.frames("desk")) == (0, 2)
    assert deep.scene_index("desk").dropped == {"without a colour image": 1, "without a depth file": 1}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda content: content.update(camera_model="EQUIRECTANGULAR"), "model EQUIRECTANGULAR; read are: PINHOLE"),
        (lambda content: content.update(w=80, h=60), "says 80x60 pixels, but the image is 40x30"),
        (lambda content: content.update(k1=1e6), "scene desk.*takes the image's border out"),
        (lambda content: content.update(frames=[]), "none of the 0 images"),
        (lambda content: content["frames"][0].update(transform_matrix=[[1]]), "scene desk.*transform_matrix"),
    ],
)
def test_refused(tmp_path, change, message):
    write(tmp_path, room(3))
    _edit(tmp_path, change)
    with pytest.raises(DataError, match=message):
        Nerfstudio(str(tmp_path)).frames("desk")


def test_size_may_come_from_the_images(tmp_path):
    """Blender's files give the field of view only."""
    write(tmp_path, room(3))

    def only_angle(content):
        for key in ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_model"):
            content.pop(key, None)
        content["camera_angle_x"] = 1.2

    _edit(tmp_path, only_angle)
    matrix = Nerfstudio(str(tmp_path)).scene_index("desk").intrinsics[0]
    focal = SIZE[1] / 2 / np.tan(0.6)
    np.testing.assert_allclose(matrix, [[focal, 0, 19.5], [0, focal, 14.5], [0, 0, 1]])
