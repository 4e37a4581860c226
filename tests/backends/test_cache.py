"""Tokens that are kept on disk are those that the backbone would make again."""

import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch

from backends import cache
from backends.cache import TokenCache, cache_key
from backends.oracle import OracleBackend


class Counting(OracleBackend):
    """Counts how often it runs."""

    def encode(self, images, hints=None):
        self.runs = [*getattr(self, "runs", []), len(images)]
        return super().encode(images, hints)


@pytest.fixture
def scene(make_scene):
    return make_scene(1, 2, (28, 42))


def test_a_second_look_is_bit_equal_and_costs_nothing(tmp_path: Path, scene) -> None:
    backend = Counting()
    first = TokenCache(tmp_path).read(backend, *scene)
    tokens, geometry = TokenCache(tmp_path).read(backend, *scene)
    TokenCache(tmp_path).read(Counting(), *scene)  # as another process would
    assert (backend.runs, len(list(tmp_path.iterdir()))) == ([1], 1)
    assert all(torch.equal(a, b) for a, b in zip(tokens.patch, first[0].patch, strict=True))
    assert torch.equal(geometry.depth, first[1].depth)
    assert torch.equal(backend.decode(tokens).depth, geometry.depth)
    assert torch.equal(geometry.cameras.world_to_camera, backend.decode(first[0]).cameras.world_to_camera)


def test_cameras_alone_are_kept_alone(tmp_path: Path, make_scene, make_backend) -> None:
    backend, views = make_backend("da3_tiny"), make_scene(1, 3, (28, 42))
    first = TokenCache(tmp_path).cameras(backend, *views)
    (file,) = tmp_path.iterdir()
    assert file.stat().st_size < 10_000
    backend.encode = lambda *views: pytest.fail("run again")
    again = TokenCache(tmp_path).cameras(backend, *views)
    expected = make_backend("da3_tiny").predict_cameras(*views)
    for found in (first, again):
        assert torch.equal(found.world_to_camera, expected.world_to_camera)
        assert torch.equal(found.intrinsics, expected.intrinsics)


def test_whatever_decides_the_result_decides_the_key(scene, make_scene, make_backend) -> None:
    images, hints = scene
    backend = Counting()
    keys = [
        cache_key(backend, images, hints),
        cache_key(backend, images.flip(1), hints),
        cache_key(backend, images, make_scene(1, 2, (28, 42), 5)[1]),
        cache_key(Counting(seed=3), images, hints),
    ]
    backend.depth_noise = 0.05
    keys.append(cache_key(backend, images, hints))
    outer = make_backend("da3_tiny")
    outer.relative = make_backend("da3_tiny")
    keys.append(cache_key(outer, *scene))
    outer.relative.reference_view = "middle"  # a nested model's relative network: its view defines the world frame
    keys.append(cache_key(outer, *scene))
    assert len(set(keys)) == 7


def test_the_source_of_somebodys_own_backend_decides_the_key(tmp_path, scene, monkeypatch):
    keys = []
    for line in ("depth = 1", "depth = 1", "depth = 2"):
        cache._source.cache_clear()  # as in another process
        module = ModuleType("somebodys_own")
        module.__file__ = str(tmp_path / "somebodys_own.py")
        Path(module.__file__).write_text(line)
        monkeypatch.setitem(sys.modules, module.__name__, module)
        own = type("Own", (OracleBackend,), {"__module__": module.__name__})
        keys.append(cache_key(own(), *scene))
    assert keys[0] == keys[1] != keys[2]


def test_a_damaged_file_is_made_again(tmp_path: Path, scene, caplog: pytest.LogCaptureFixture) -> None:
    backend, cache = Counting(), TokenCache(tmp_path)
    first = cache.read(backend, *scene)[0].patch[0]
    (file,) = tmp_path.glob("*.pt")
    file.write_bytes(file.read_bytes()[:1000])
    for _ in range(2):
        assert torch.equal(cache.read(backend, *scene)[0].patch[0], first)
    assert "computing it again" in caplog.text
    assert backend.runs == [1, 1]


def test_the_oldest_go_when_the_folder_is_full(tmp_path: Path, make_scene) -> None:
    backend = Counting()
    TokenCache(tmp_path).read(backend, *make_scene(1, 2, (28, 42), 0))
    (first,) = tmp_path.glob("*.pt")
    cache = TokenCache(tmp_path, max_gb=2.5 * first.stat().st_size / 1e9)
    for seed in (1, 2, 3):
        cache.read(backend, *make_scene(1, 2, (28, 42), seed))
    assert len(list(tmp_path.glob("*.pt"))) == 2
    assert not first.exists()
    with pytest.raises(ValueError, match=r"token_cache\.max_gb"):
        TokenCache(tmp_path, 0)
