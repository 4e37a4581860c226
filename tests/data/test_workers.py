"""The default number of loader processes."""

import os
from functools import partial
from types import SimpleNamespace

import pytest
import torch

from vg2gt.data import SceneDataModule, SyntheticScenes, datamodule
from vg2gt.data.datamodule import MOST, automatic_workers


@pytest.fixture
def machine(monkeypatch):
    """A machine with other numbers of cores, GB of memory and GB of shared memory."""

    def make(cores=64, memory=512.0, shared=256.0):
        monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(cores)), raising=False)
        monkeypatch.setattr(os, "sysconf", lambda name: int(memory * 1e9) if name == "SC_PHYS_PAGES" else 1)
        monkeypatch.setattr(datamodule.shutil, "disk_usage", lambda path: SimpleNamespace(free=int(shared * 1e9)))

    return make


@pytest.mark.parametrize(
    ("here", "ranks", "expected"),
    [
        ({}, 1, MOST),
        ({}, 8, 7),  # a core for the rank itself
        ({"memory": 32}, 2, 4),
        ({"shared": 0.064}, 1, 0),  # a container's
    ],
)
def test_cores_and_memory_bound_the_loaders(here, ranks, expected, machine):
    machine(**here)
    assert automatic_workers(ranks, memory_mb=1024, batch_mb=30) == expected


def test_only_gpus_are_fed_by_processes_of_their_own(machine):
    machine()
    scenes = partial(SyntheticScenes, 1, num_frames=4, size=(28, 56))
    data = SceneDataModule(scenes, scenes, image_size=(28, 56), min_views=2, max_views=2, max_images=2)
    assert data.loader_processes == 0
    for device, expected in (("cpu", 0), ("cuda", 15)):
        data.trainer = SimpleNamespace(  # pyright: ignore
            strategy=SimpleNamespace(root_device=torch.device(device)), num_devices=4
        )
        assert data.loader_processes == expected
    data.workers = 3
    assert data.loader_processes == 3
