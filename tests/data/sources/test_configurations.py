"""Configurations of datasets on disk, as a run composes them: two scenes of a layout train and evaluate."""

from pathlib import Path

import pytest
from hydra.utils import instantiate

from tests.commands import ROOT
from vg2gt.config import compose
from vg2gt.data import SceneDataModule

from . import layout_infinigen, layout_replica, layout_scannet, layout_scannetpp, layout_tum, layout_virtual_kitti
from .layouts import room


def _infinigen(root: Path, frames) -> None:
    names = [f"0_0_{i:04d}_0" for i in range(len(frames.images))]
    layout_infinigen.write(root / "a", frames, names, 2)


def _lists(root: Path, prefix: str, train: str, val: str) -> None:
    for name, scene in (("train", train), ("val", val)):
        path = root / f"{prefix}{name}.txt"
        path.parent.mkdir(exist_ok=True)
        path.write_text(scene + "\n")


def _scannet(root: Path, frames) -> None:
    for scene in ("scene0000_00", "scene0001_00"):
        layout_scannet.write_export(root, frames, scene)
    _lists(root, "scannetv2_", "scene0000_00", "scene0001_00")


def _scannet_sens(root: Path, frames) -> None:
    path = layout_scannet.write_sens(root, frames)
    path.with_name("scene0708_00.sens").write_bytes(path.read_bytes())
    _lists(root, "scannetv2_", path.stem, "scene0708_00")


def _scannetpp(root: Path, frames) -> None:
    for scene in ("1", "2"):
        layout_scannetpp.write(root / scene, frames)
        (root / scene / "processed" / "0a5c013435").rename(root / f"scene{scene}")
    _lists(root, "splits/nvs_sem_", "scene1", "scene2")


def _replica(root: Path, frames) -> None:
    for scene in ("office0", "office1", "office2", "office3", "office4", "room0", "room1", "room2"):
        layout_replica.write(root, frames, scene)


def _virtual_kitti(root: Path, frames) -> None:
    for scene in ("Scene01/rain", "Scene02/clone", "Scene06/fog", "Scene18/clone", "Scene20/clone", "Scene20/rain"):
        layout_virtual_kitti.write(root, frames, scene)


EXAMPLES = ROOT / "examples" / "data_sets" / "configs"
REPLICA = "data.intrinsics=[27,27,19.5,14.5]"
CONFIGURATIONS = {
    "infinigen": (_infinigen, [], {"a"}, {"a"}),
    "scannet": (_scannet, ["data.every=1"], {"scene0000_00"}, {"scene0001_00"}),
    "scannet_sens": (_scannet_sens, ["data.every=1"], {"scene0707_00"}, {"scene0708_00"}),
    "scannetpp": (_scannetpp, [], {"scene1"}, {"scene2"}),
    "replica": (
        _replica,
        ["data.every=1", REPLICA],
        {"office0", "office1", "office2", "office3", "room0", "room1"},
        {"office4", "room2"},
    ),
    "virtual_kitti": (
        _virtual_kitti,
        [],
        {f"{drive}/Camera_0" for drive in ("Scene01/rain", "Scene02/clone", "Scene06/fog", "Scene18/clone")},
        {"Scene20/clone/Camera_0"},
    ),
    "tum": (layout_tum.write, ["data.every=1"], {"rgbd_dataset_freiburg1_desk"}, {"rgbd_dataset_freiburg1_desk"}),
}


@pytest.fixture(scope="module")
def frames():
    return room()


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_scenes_are_split_and_batched(tmp_path, frames, name):
    write, changes, train, val = CONFIGURATIONS[name]
    write(tmp_path / "data", frames)
    small = ["image_size=[28,42]", "min_views=2", "max_views=2", "max_images=2", "target_views=0", "eval_context=2"]
    examples = [f"hydra.searchpath=[{EXAMPLES}]"] if (EXAMPLES / "data" / f"{name}.yaml").is_file() else []
    overrides = [
        *examples,
        f"data={name}",
        f"data.root={tmp_path / 'data'}",
        f"data.index_cache={tmp_path / 'cache'}",
        *changes,
    ]
    config = compose("train", *overrides, *(f"data.{change}" for change in small), "data.eval_target=1")
    module = instantiate(config.data)
    assert isinstance(module, SceneDataModule)
    assert set(module.train_source().scenes) == train
    batches = list(module.val_dataloader())
    assert {batch.scene[0] for batch in batches} == val
    for batch in (batches[0], next(iter(module.train_dataloader()))):
        assert batch.images.shape[-3:] == (3, 28, 42)
        assert bool((batch.depth > 0).flatten(2).any(2).all())


def test_worlds_and_infinigen_rooms_are_mixed(tmp_path, frames):
    """The mixture that the head in the package was trained on."""
    for end in ("train", "val"):
        _infinigen(tmp_path / end, frames)
    (tmp_path / "val/a").rename(tmp_path / "val/b")
    roots = [f"data.{end}.parts.infinigen.root={tmp_path / end}" for end in ("train", "val")]
    small = ["image_size=[28,42]", "min_views=2", "max_views=2", "max_images=2", "eval_context=2", "train_scenes=4"]
    where = [f"hydra.searchpath=[{ROOT / 'examples/worlds/configs'}]", "data=worlds_infinigen", *roots]
    config = compose("train", *where, f"data.worlds_cache_dir={tmp_path}", *(f"data.{change}" for change in small))
    module = instantiate(config.data)
    scenes = module.train_source().scenes
    assert "infinigen/a" in scenes
    assert sum(scene.startswith("worlds/") for scene in scenes) >= 3
    assert {batch.scene[0].split("/")[0] for batch in module.val_dataloader()} == {"worlds", "infinigen"}
