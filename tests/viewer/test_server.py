"""The live viewer listens on this machine only, publishes nothing by itself, and stops."""

import importlib.util
import os
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.io.gaussian_scenes import scene, views
from vg2gt.io import named_cameras, write_gaussian_ply
from vg2gt.viewer import ViewerScene, start_server

pytestmark = pytest.mark.skipif(importlib.util.find_spec("viser") is None, reason="needs viser: pip install viser")


@pytest.fixture(scope="module")
def shown() -> ViewerScene:
    cameras = named_cameras(views(), ["a/b.png", "../c.png", "a/b.png"])
    return ViewerScene(scene(50, 2), cameras, [np.full((4, 6, 3), 90, np.uint8), None, None])


@pytest.fixture(scope="module")
def server(shown: ViewerScene) -> Iterator:
    running = start_server(shown, port=0)
    yield running
    running.stop()


def listening() -> set[tuple[str, int]]:
    """Addresses this process listens on, of both protocol families, as the kernel lists them."""
    inodes = set()
    for link in Path("/proc/self/fd").iterdir():
        try:
            name = os.readlink(link)
        except OSError:
            continue
        if name.startswith("socket:["):
            inodes.add(name[8:-1])
    found = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/self/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            local, state, inode = fields[1], fields[3], fields[9]
            if state == "0A" and inode in inodes:
                address, port = local.split(":")
                packed = bytes.fromhex(address)
                words = b"".join(packed[i : i + 4][::-1] for i in range(0, len(packed), 4))
                family = socket.AF_INET if len(words) == 4 else socket.AF_INET6
                found.add((socket.inet_ntop(family, words), int(port, 16)))
    return found


def test_page_is_served_to_this_machine_only(server) -> None:
    port = server.get_port()
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=30) as answer:
        assert answer.status == 200
        assert b"<html" in answer.read().lower()
    if not sys.platform.startswith("linux"):
        pytest.skip("the kernel's list of sockets is read on Linux only")
    assert {address for address, used in listening() if used == port} == {"127.0.0.1"}


def test_nothing_is_published_unless_asked(server, monkeypatch: pytest.MonkeyPatch) -> None:
    import viser  # pyright: ignore[reportMissingImports]

    asked = []
    monkeypatch.setattr(viser.ViserServer, "request_share_url", lambda self, verbose=True: asked.append(1) or "url")
    assert server.request_share_url() is None  # what the page's button calls
    assert asked == []
    sharing = start_server(ViewerScene(scene(5)), port=0, share=True)
    try:
        assert asked == []  # allowed is not done
        assert sharing.request_share_url() == "url"
    finally:
        sharing.stop()


def test_command_serves_until_interrupted(tmp_path: Path) -> None:
    path = write_gaussian_ply(tmp_path / "scene.ply", scene(20))
    # What a shell starts in the background ignores SIGINT, and so does what it starts.
    code = "import signal, vg2gt.cli; signal.signal(signal.SIGINT, signal.default_int_handler); vg2gt.cli.main()"
    command = [sys.executable, "-c", code, "view", str(path), "--port", "0"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)
    try:
        lines = iter(process.stdout.readline, "")
        address = next(line.split()[0] for line in lines if line.startswith("http://127.0.0.1:"))
        with urllib.request.urlopen(address, timeout=30) as answer:
            assert answer.status == 200
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0, errors
