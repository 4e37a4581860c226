"""Configurations of datasets on disk, as a run composes them: two scenes of a layout train and evaluate."""

from pathlib import Path

import pytest
from hydra.utils import instantiate

from tests.commands import ROOT
from vg2gt.config import compose
from vg2gt.data import SceneDataModule

from . import layout_infinigen, layout_replica, layout_scannet, layout_tum
from .layouts import room


def _infinigen(root: Path, *_) -> None:
    layout_infinigen.write(root / "a", room(), [f"0_0_{i:04d}_0" for i in range(6)], 2)


def _lists(start: str, *scenes: str) -> None:
    for end, scene in zip(("train.txt", "val.txt"), scenes, strict=True):
        Path(start + end).write_text(scene + "\n")


def _scannet(root: Path, *scenes: str) -> None:
    for scene in scenes:
        layout_scannet.write_export(root, room(), scene)
    _lists(f"{root}/scannetv2_", *scenes)


def _scannet_sens(root: Path, first: str, second: str) -> None:
    path = layout_scannet.write_sens(root, room())
    path.with_name(f"{second}.sens").write_bytes(path.read_bytes())
    _lists(f"{root}/scannetv2_", first, second)


def _replica(root: Path, *scenes: str) -> None:
    for scene in scenes:
        layout_replica.write(root, room(), scene)


def _tum(root: Path, scene: str, _) -> None:
    layout_tum.write(root, room(), scene)


EXAMPLES = ROOT / "examples" / "data_sets" / "configs"
TUM = "rgbd_dataset_freiburg1_desk"
EVERY = "data.every=1"
SMALL = ["data.image_size=[28,42]", "data.min_views=2", "data.max_views=2", "data.max_images=2", "data.eval_context=2"]


@pytest.mark.parametrize(
    ("name", "write", "train", "val", "changes"),
    [
        ("infinigen", _infinigen, ["a"], ["a"], []),
        ("scannet", _scannet, ["scene0000_00"], ["scene0001_00"], [EVERY]),
        ("scannet_sens", _scannet_sens, ["scene0707_00"], ["scene0708_00"], [EVERY]),
        (
            "replica",
            _replica,
            ["office0", "office1", "office2", "office3", "room0", "room1"],
            ["office4", "room2"],
            [EVERY, "data.intrinsics=[27,27,19.5,14.5]"],
        ),
        ("tum", _tum, [TUM], [TUM], [EVERY]),
    ],
)
def test_scenes_are_split_and_batched(tmp_path, name, write, train, val, changes):
    write(tmp_path / "data", *train, *val)
    examples = [f"hydra.searchpath=[{EXAMPLES}]"] if (EXAMPLES / "data" / f"{name}.yaml").is_file() else []
    where = [f"data={name}", f"data.root={tmp_path / 'data'}", f"data.index_cache={tmp_path / 'cache'}"]
    config = compose("train", *examples, *where, *changes, *SMALL, "data.target_views=0", "data.eval_target=1")
    module = instantiate(config.data)
    assert isinstance(module, SceneDataModule)
    assert sorted(module.train_source().scenes) == train
    batches = list(module.val_dataloader())
    assert {batch.scene[0] for batch in batches} == set(val)
    for batch in (batches[0], next(iter(module.train_dataloader()))):
        assert batch.images.shape[-3:] == (3, 28, 42)
        assert bool((batch.depth > 0).flatten(2).any(2).all())


def test_worlds_and_infinigen_rooms_are_mixed(tmp_path):
    """The mixture that the head in the package was trained on."""
    for end in ("train", "val"):
        _infinigen(tmp_path / end)
    (tmp_path / "val/a").rename(tmp_path / "val/b")
    roots = [f"data.{end}.parts.infinigen.root={tmp_path / end}" for end in ("train", "val")]
    where = [f"hydra.searchpath=[{ROOT / 'examples/worlds/configs'}]", "data=worlds_infinigen", *roots]
    config = compose("train", *where, f"data.worlds_cache_dir={tmp_path}", *SMALL, "data.train_scenes=4")
    module = instantiate(config.data)
    scenes = module.train_source().scenes
    assert "infinigen/a" in scenes
    assert sum(scene.startswith("worlds/") for scene in scenes) >= 3
    assert {batch.scene[0].split("/")[0] for batch in module.val_dataloader()} == {"worlds", "infinigen"}
