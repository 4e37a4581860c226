"""Pictures, headers and names that ask for too much, for other programs, or for files that are not theirs."""

import json
import os
import signal
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from vg2gt import io as formats
from vg2gt.data import DataError
from vg2gt.data.sources import COLMAP, Nerfstudio
from vg2gt.data.sources.parsing import read_numbers
from vg2gt.io.arrays import load_npz
from vg2gt.io.cameras_json import NamedCamera
from vg2gt.io.image_files import image_size, read_color, read_depth
from vg2gt.io.tensors import read_tensors
from vg2gt.runs.checkpoints import read_checkpoint
from vg2gt.runs.untrusted import read_run_config
from vg2gt.viewer import load_pictures

HUGE = 1 << 60


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png_of(width: int, height: int, more: bytes = b"") -> bytes:
    """A PNG file that claims a size and holds next to nothing."""
    head = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return head + more + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


# A program; Pillow would hand it to Ghostscript, whatever the file's name says.
EPS = "%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n({}) (w) file closefile\nshowpage\n%%EOF\n"
PICTURES: dict[str, Callable[[Path], bytes]] = {
    "bomb": lambda canary: png_of(100_000, 100_000),
    "postscript": lambda canary: EPS.format(canary).encode(),
    "svg": lambda canary: b'<svg xmlns="http://www.w3.org/2000/svg"><image href="file:///etc/passwd"/></svg>',
    "netpbm bomb": lambda canary: b"P6 1000000 1000000 255\n" + bytes(9),
    "text bomb": lambda canary: png_of(1, 1, chunk(b"zTXt", b"Comment\0\0" + zlib.compress(bytes(80 << 20)))),
    "python": lambda canary: f"import os\nopen({str(canary)!r}, 'w')\n".encode(),
}


@pytest.mark.parametrize("name", PICTURES)
def test_pictures(tmp_path: Path, canary: Path, name: str) -> None:
    path = tmp_path / "0001.png"
    path.write_bytes(PICTURES[name](canary))
    for read in (read_color, partial(read_color, upright=True), read_depth):
        with pytest.raises(DataError, match=r"cannot read .*0001\.png of scene s"):
            read(path, "s")
    camera = NamedCamera("0001.png", 9, 9, np.eye(3), np.eye(4))
    with pytest.raises(ValueError, match=r"cannot read .*0001\.png"):
        load_pictures([camera], tmp_path)
    if "bomb" not in name:
        for upright in (False, True):
            with pytest.raises(DataError, match=r"cannot read .*0001\.png of scene s"):
                image_size(path, "s", upright)
    moving = tmp_path / "moving.gif"
    moving.write_bytes(path.read_bytes())
    with pytest.raises(formats.FormatError, match=r"moving\.gif"):
        list(formats.read_video(moving))


def ply(lines: str) -> bytes:
    return f"ply\nformat binary_little_endian 1.0\n{lines}end_header\n".encode() + bytes(64)


POSITION = "property float x\nproperty float y\nproperty float z\n"
PLYS = {
    "2^60 before": ply(f"element other {HUGE}\nproperty double a\nelement vertex 1\n{POSITION}"),
    "10^30 vertices": ply(f"element vertex 1{'0' * 30}\n{POSITION}"),
    "endless header": b"ply\nformat ascii 1.0\n" + b"comment x\n" * 100_000,
    "many properties": ply("element vertex 1\n" + "".join(f"property float p{i}\n" for i in range(9000))),
}


@pytest.mark.parametrize("name", PLYS)
def test_ply_headers(tmp_path: Path, name: str) -> None:
    path = tmp_path / "scene.ply"
    path.write_bytes(PLYS[name])
    with pytest.raises(formats.FormatError, match=r"scene\.ply"):
        formats.read_gaussian_ply(path)


COUNT = struct.pack("<Q", HUGE)
CAMERA = struct.pack("<QIiQQ4d", 1, 1, 1, 64, 48, 50, 50, 32, 24)
POSE = struct.pack("<I7dI", 1, 1, 0, 0, 0, 0, 0, 0, 1)
MODELS = {
    "2^60 features": {"images": struct.pack("<Q", 1) + POSE + b"a.png\0" + COUNT + bytes(64)},
    "2^60 observations": {"points3D": struct.pack("<Q", 1) + struct.pack("<Q3d3BdQ", 1, 0, 0, 0, 0, 0, 0, 0, HUGE)},
    "endless name": {"images": struct.pack("<Q", 1) + POSE + b"a" * 100_000},
}


def colmap_model(folder: Path, name: str = "a.png", files: Mapping[str, bytes] | None = None) -> Path:
    folder.mkdir(parents=True)
    image = struct.pack("<Q", 1) + POSE + name.encode() + b"\0" + bytes(8)
    for file, content in {"cameras": CAMERA, "images": image, "points3D": bytes(8), **(files or {})}.items():
        (folder / f"{file}.bin").write_bytes(content)
    return folder


@pytest.mark.parametrize("name", MODELS)
def test_colmap_headers(tmp_path: Path, name: str) -> None:
    assert formats.read_colmap(colmap_model(tmp_path / "good")).image(1).name == "a.png"
    with pytest.raises(formats.FormatError, match=r"bad"):
        formats.read_colmap(colmap_model(tmp_path / "bad", files=MODELS[name]))


NAMES = ["../secret.png", "/etc/passwd", "a/../../secret.png", "images/../../secret.png", "../scene/../secret.png"]


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    """An image outside the scene's folder, which no scene may read."""
    path = tmp_path / "secret.png"
    Image.new("RGB", (64, 48), "red").save(path)
    return path


@pytest.mark.parametrize("name", [*NAMES, "SECRET"])
@pytest.mark.parametrize("field", ["file_path", "depth_file_path"])
def test_transforms_name_files_of_their_folder(tmp_path: Path, secret: Path, name: str, field: str) -> None:
    folder = tmp_path / "scene"
    folder.mkdir()
    Image.new("RGB", (64, 48)).save(folder / "a.png")
    frame = {"file_path": "a.png", "depth_file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
    frame[field] = str(secret) if name == "SECRET" else name
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 50, "frames": [frame]}))
    source = Nerfstudio(str(folder), depth=True)
    with pytest.raises(DataError, match=r"transforms\.json of scene scene names the file .* which lies outside"):
        source.frames("scene")


@pytest.mark.parametrize("name", [*NAMES, "SECRET"])
def test_colmap_models_name_images_of_their_folder(tmp_path: Path, secret: Path, name: str) -> None:
    colmap_model(tmp_path / "scene" / "sparse" / "0", str(secret) if name == "SECRET" else name)
    (tmp_path / "scene" / "images").mkdir()
    with pytest.raises(DataError, match=r"names the file .* which lies outside .*images"):
        COLMAP(str(tmp_path / "scene")).frames("scene")


def test_names_inside_and_links_of_the_users_own_are_fine(tmp_path: Path) -> None:
    folder, elsewhere = tmp_path / "scene", tmp_path / "large_disk"
    elsewhere.mkdir()
    folder.mkdir()
    Image.new("RGB", (64, 48)).save(elsewhere / "a.png")
    (folder / "images").symlink_to(elsewhere)
    names = ["images/a.png", "./images/a.png", str(folder / "images" / "a.png"), "x/../images/a.png"]
    frames = [{"file_path": name, "transform_matrix": np.eye(4).tolist()} for name in names]
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 50, "frames": frames}))
    assert len(Nerfstudio(str(folder)).frames("scene")) == 4


@pytest.fixture
def patience() -> Iterator[None]:
    """A reader that waits is a failure, not a hanging test."""
    before = signal.signal(signal.SIGALRM, lambda *_: pytest.fail("the reader waits for a pipe"))
    signal.setitimer(signal.ITIMER_REAL, 5)
    yield
    signal.setitimer(signal.ITIMER_REAL, 0)
    signal.signal(signal.SIGALRM, before)


PIPES: dict[str, Callable[[Path], object]] = {
    "photo.png": lambda path: read_color(path, "room"),
    "depth.png": lambda path: read_depth(path, "room"),
    "size.png": lambda path: image_size(path, "room"),
    "poses.txt": lambda path: read_numbers(path, "room"),
    "depth.npz": lambda path: load_npz(path, "room", ["depth"]),
    "scene.ply": formats.read_gaussian_ply,
    "scene.spz": formats.read_spz,
    "scene.glb": formats.read_gaussian_gltf,
    "clip.mp4": lambda path: list(formats.read_video(path)),
    "clip.gif": lambda path: list(formats.read_video(path)),
    "cameras.json": formats.read_cameras_json,
    "transforms.json": formats.read_transforms,
    "cameras.txt": lambda path: formats.read_colmap(path.parent),
    "cameras.bin": lambda path: formats.read_colmap(path.parent),
    "model.pt": read_tensors,
    "model.safetensors": read_tensors,
    "step-1.ckpt": read_checkpoint,
    "config.yaml": read_run_config,
}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
@pytest.mark.parametrize("name", PIPES)
@pytest.mark.usefixtures("patience")
def test_named_pipes_are_not_waited_for(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / name)
    with pytest.raises((ValueError, OSError)):
        PIPES[name](tmp_path / name)


def test_pictures_of_another_size_are_refused_before_they_are_decoded(tmp_path, monkeypatch):
    (tmp_path / "large.png").write_bytes(png_of(13_000, 13_000))
    monkeypatch.setattr("PIL.ImageFile.ImageFile.load", lambda *_: pytest.fail("it was decoded"))
    with pytest.raises(DataError, match=r"large\.png of scene room is 13000x13000 pixels"):
        read_color(tmp_path / "large.png", "room", (480, 640))
