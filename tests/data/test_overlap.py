"""Training and evaluation data that overlap are found whatever loaders read them."""

from collections.abc import Sequence

import pytest

from vg2gt.data import DataError, Mixture, SceneSource, SyntheticScenes
from vg2gt.data.overlap import refuse_overlap
from vg2gt.data.views import SceneSample


class Scans(SyntheticScenes):
    """Two scans per room, every third frame held out."""

    first = 0

    @property
    def scenes(self) -> Sequence[str]:
        return tuple(f"scene{room:04d}_{scan:02d}" for room in range(self.first, self.first + 2) for scan in range(2))

    def frames(self, scene: str) -> Sequence[int]:
        return range(9)

    def held_out(self, scene: str) -> Sequence[int]:
        return (2, 5, 8)

    def place(self, scene: str) -> str:
        return scene.split("_")[0]


class OtherReader(Scans):
    """Another loader of the same recordings."""


def _check(train: SceneSource, trained: Sequence[str], val: SceneSource, scene: str, target: tuple[int, ...]) -> None:
    refuse_overlap(train, trained, val, [SceneSample(scene, (0, 1), target)])


def _mixture(**parts: SceneSource) -> Mixture:
    return Mixture(parts, dict.fromkeys(parts, 1))


@pytest.mark.parametrize(
    ("train", "trained", "val", "scene"),
    [
        (Scans(1), "scene0001_00", OtherReader(1), "scene0001_01"),
        (_mixture(scans=Scans(1)), "scans/scene0001_00", _mixture(mine=OtherReader(1)), "mine/scene0001_01"),
    ],
)
def test_a_place_is_known_in_every_reader_and_mixture(train, trained, val, scene):
    with pytest.raises(DataError, match=f"evaluation scene {scene} and training scene {trained} show the same place"):
        _check(train, [trained], val, scene, (5,))
    _check(train, [trained], val, scene.replace("0001", "0000"), (5,))


def test_of_a_scene_trained_on_only_held_out_frames_are_scored():
    train = _mixture(scans=Scans(1), rooms=SyntheticScenes(1))
    for val, scene in ((OtherReader(1), "scene0001_00"), (train, "scans/scene0001_00")):
        _check(train, list(train.scenes), val, scene, (2, 8))
        for target in ((2, 3), (100,)):  # 100 was not trained on, but lies among frames that were
            with pytest.raises(DataError, match=f"{scene} is used for training and for evaluation: 1 of its"):
                _check(train, list(train.scenes), val, scene, target)
