"""Long captures: windows give what all views at once give."""

import itertools
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.data.sources.layout_rgbd import write_recording
from tests.reconstruction.by_itself import ByHeart, ByItself
from vg2gt.cli import reconstruct as command
from vg2gt.data import SyntheticScenes
from vg2gt.geometry.alignment import align_cameras
from vg2gt.inputs.given_cameras import given_pictures
from vg2gt.metrics import psnr
from vg2gt.reconstruction.pipeline import reconstruct_with
from vg2gt.reconstruction.trust import trusted
from vg2gt.reconstruction.windows import run as windows_run
from vg2gt.reconstruction.windows import store
from vg2gt.reconstruction.windows.store import cut, merge_windows, window_size
from vg2gt.runs.load import load_model

BY_ITSELF = ["backend=custom", f"backend._target_={ByItself.__module__}.ByItself", "model=tiny_ungated"]
VIEWS = 14


@pytest.fixture(autouse=True)
def few_neighbours(monkeypatch) -> None:
    """Or windows of these few views would see all of them."""
    monkeypatch.setattr(store, "MARGIN", 1)


@pytest.fixture(scope="module")
def frames_of_walk():
    source = SyntheticScenes(1, first_seed=3, num_frames=VIEWS, size=(56, 84))
    return source.load(source.scenes[0], range(VIEWS))


@pytest.fixture(scope="module")
def walk(frames_of_walk, tmp_path_factory) -> Path:
    return write_recording(tmp_path_factory.mktemp("walks"), frames_of_walk, "walk", first=0, digits=3)


def built(start: str):
    return load_model(overrides=[*BY_ITSELF, "model.coarse=null", f"model.gaussians.start={start}"], device="cpu").model


@pytest.fixture(scope="module")
def model():
    return built("plain")


@pytest.fixture(scope="module")
def whole(model, walk):
    return reconstruct_with(model, walk, window=0)


def close(ours, whole) -> None:
    assert len(ours.gaussians) == len(whole.gaussians)
    for name, atol in (("means", 2e-5), ("scales", 2e-5), ("opacities", 1e-4), ("sh", 1e-3), ("background", 1e-5)):
        assert_close(getattr(ours.gaussians, name), getattr(whole.gaussians, name), atol=atol, rtol=1e-3)
    assert torch.equal(ours.depth, whole.depth)
    assert_close(ours.cameras.world_to_camera, whole.cameras.world_to_camera, atol=1e-6, rtol=0)


def test_windows_give_the_gaussians_of_all_views_at_once(model, walk, whole, monkeypatch) -> None:
    """Also where tokens are not kept, but made again."""
    monkeypatch.setattr(windows_run, "TOKEN_BYTES", 0)
    calls = model.backend._calls
    close(reconstruct_with(model, walk, window=8), whole)
    assert model.backend._calls == calls + 2 * len(cut(VIEWS, 8))


def test_windows_know_what_views_confirm(model, walk, whole) -> None:
    """One window of all views knows it exactly; smaller ones compare each view with fewer others."""
    calibration = load_model(device="cpu").calibration
    known = reconstruct_with(model, walk, window=0, calibration=calibration)
    one = reconstruct_with(model, walk, window=VIEWS, calibration=calibration)
    assert known.error is not None
    assert one.error is not None
    assert torch.equal(one.support, known.support)
    assert_close(one.error, known.error, atol=1e-5, rtol=1e-3)
    some = reconstruct_with(model, walk, window=6)
    assert some.error is None
    assert (some.support == known.support).float().mean() > 0.9
    assert len(trusted(some, drop=["single", "contradicted"]).gaussians) < len(some.gaussians)


def test_surfels_look_as_those_of_all_views_at_once(walk) -> None:
    """Where a voxel has no direction, rounding decides which of its Gaussians comes first."""
    model = built("surfel")
    whole, ours = (reconstruct_with(model, walk, window=window) for window in (0, 6))
    same = (ours.gaussians.means - whole.gaussians.means).abs().amax(1) < 2e-5
    assert same.float().mean() > 0.9
    for one, other in zip(list(whole.render())[::5], list(ours.render())[::5], strict=True):
        assert psnr(other.color[None], one.color[None])[0] > 45


@pytest.mark.parametrize("given", [False, True])
def test_windows_of_predicted_cameras_are_placed_in_one_frame(frames_of_walk, walk, tmp_path, given) -> None:
    model = built("plain")
    model.backend = ByHeart(frames_of_walk)
    model.backend.needs_hints = given  # takes the cameras next to the images, but predicts its own
    images = walk if given else shutil.copytree(walk / "images", tmp_path / "photos")
    whole, ours = (reconstruct_with(model, images, window=window) for window in (0, 6))
    assert ours.cameras.size == whole.cameras.size == (56, 84)
    move = align_cameras(ours.cameras, whole.cameras)
    moved = move.apply_cameras(ours.cameras)
    assert_close(moved.world_to_camera, whole.cameras.world_to_camera, atol=1e-4, rtol=0)
    both = (ours.depth > 0) & (whole.depth > 0)
    assert both.float().mean() > 0.9
    assert_close(ours.depth[both] * move.scale, whole.depth[both], atol=1e-4, rtol=1e-4)
    assert abs(len(ours.gaussians) - len(whole.gaussians)) < 0.02 * len(whole.gaussians)


def test_an_interrupted_run_goes_on(model, walk, whole, tmp_path, monkeypatch) -> None:
    """And not with the files of other views in the same folder."""
    reconstruct_with(model, walk, window=5, max_images=10, window_folder=tmp_path / "windows")
    calls = model.backend._calls
    pool, pooled = model.fine.pool, []

    def stop(*inputs, capped):
        if len(pooled) == 2:
            raise KeyboardInterrupt
        pooled.append(pool(*inputs, capped=capped))
        return pooled[-1]

    monkeypatch.setattr(model.fine, "pool", stop)
    with pytest.raises(KeyboardInterrupt):
        reconstruct_with(model, walk, window=5, window_folder=tmp_path / "windows")
    windows = len(cut(VIEWS, 5))
    assert model.backend._calls == calls + windows
    monkeypatch.setattr(model.fine, "pool", pool)
    close(reconstruct_with(model, walk, window=5, window_folder=tmp_path / "windows"), whole)
    assert model.backend._calls == calls + windows  # nothing ran again


def test_merging_in_slabs_changes_nothing(model, walk, tmp_path, monkeypatch) -> None:
    found = {}

    def both(files, monitor):
        found["whole"] = merge_windows(files, monitor)
        found["slabs"] = merge_windows(files, monitor, limit=500)
        return found["whole"]

    monkeypatch.setattr(windows_run, "merge_windows", both)
    reconstruct_with(model, walk, window=8)
    for one, other in zip(vars(found["whole"]).values(), vars(found["slabs"]).values(), strict=True):
        assert torch.equal(one, other)


def test_windows_are_for_many_views_overlap_and_own_every_view_once() -> None:
    for wanted, views, size in ((None, 100, 0), (None, 101, 24), (0, 1000, 0), (8, 8, 0)):
        assert window_size(wanted, views) == size
    with pytest.raises(ValueError, match="at least 4"):
        window_size(3, 100)
    for count, size in itertools.product((5, 24, 25, 60, 131), (4, 5, 8, 24, 59)):
        windows = cut(count, size)
        assert [view for w in windows for view in w.views[w.inner].tolist()] == list(range(count))
        for window in windows:
            views = window.views.tolist()
            assert views == list(range(views[0], views[-1] + 1))
            assert 0 <= views[0] <= views[-1] < count
            assert window.own.stop - window.own.start <= size
        for before, after in itertools.pairwise(windows):
            assert len(set(before.views.tolist()) & set(after.views.tolist())) >= min(store.MARGIN, count)


def test_the_command_makes_windows_and_tiles_and_clears_up(walk, tmp_path, monkeypatch) -> None:
    out = tmp_path / "out"
    monkeypatch.setattr(command, "LARGE", 100)
    arguments = [str(walk), "--out", str(out), "--window", "6", "--quiet", "--device", "cpu", *BY_ITSELF]
    command.main(arguments)
    assert not (out / "windows").exists()
    (out / "windows" / "mine").mkdir(parents=True)
    command.main([*arguments, "--overwrite"])
    assert [path.name for path in (out / "windows").iterdir()] == ["mine"]
    report = json.loads((out / "report.json").read_text())
    assert report["views"] == VIEWS
    assert json.loads((out / "tiles" / "index.json").read_text())["gaussians"] == report["gaussians"]
    assert "windows" in report["seconds"]


def test_windows_of_other_cameras_or_content_are_not_reused(model, walk, tmp_path) -> None:
    pictures = given_pictures(walk, depth=True)
    assert pictures is not None
    first = pictures[0]
    clip = tmp_path / "clip.mp4"
    clip.write_bytes(b"1")
    others = [replace(first, pose=first.pose + 1), replace(first, intrinsics=2 * first.intrinsics)]
    others.append(replace(first, container=clip))
    keys = {store.set_key(model, [each, *pictures[1:]], (56, 84), 4) for each in (first, *others)}
    clip.write_bytes(b"12")
    assert len(keys | {store.set_key(model, [others[-1], *pictures[1:]], (56, 84), 4)}) == 5


def test_windows_keep_map_coordinates(model, walk, tmp_path) -> None:
    far = np.array([500_000.0, 4_000_000.0, 100.0])
    poses = np.loadtxt(walk / "poses.txt").reshape(-1, 4, 4)
    poses[:, :3, 3] += far
    moved = shutil.copytree(walk, tmp_path / "walk")
    np.savetxt(moved / "poses.txt", poses.reshape(len(poses), -1), fmt="%.9f")
    scene = reconstruct_with(model, moved, window=6)
    assert scene.frame is not None
    assert scene.poses is not None
    found = scene.frame.to_source @ np.linalg.inv(scene.poses.numpy())
    np.testing.assert_allclose(found[:, :3, 3], poses[:, :3, 3], rtol=0, atol=1e-3)


def test_a_model_without_voxels_says_so(walk) -> None:
    pixels = load_model(overrides=["backend=oracle", "model=pointcloud"], device="cpu").model
    with pytest.raises(ValueError, match="--window 0"):
        reconstruct_with(pixels, walk, window=5)
