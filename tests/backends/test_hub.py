"""Weights through the real ``huggingface_hub`` client, from a hub in miniature on this machine.

The client reads its settings when it is imported, so every setting gets a process of its own.
"""

import hashlib
import json
import os
import re
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import pytest
from safetensors.torch import save

from tests.commands import ROOT, run_python

pytest.importorskip("huggingface_hub")

ADDRESS = re.compile(r"/([^/]+/[^/]+)/resolve/([^/]+)/(.+)")  # repository, revision, file
FILE = "model.safetensors"

# Loads backends given as [[name, override, ...], ...]; prints for each the weights' hash, or what was raised.
LOAD = """
import json, sys, time
assert "huggingface_hub" not in sys.modules
from hydra.utils import instantiate
from vg2gt.config import compose

time.sleep = lambda seconds: None  # the client's pauses between its attempts to reach the hub
results = []
for name, *overrides in json.loads(sys.argv[1]):
    config = compose(None, f"+backend={name}", *(f"backend.{override}" for override in overrides)).backend
    try:
        results.append(instantiate(config).identity()["weights"])
    except Exception as error:
        results.append(f"{type(error.__cause__).__name__}: {error.__cause__}")
print(json.dumps(results))
"""


def commit(revision: str) -> str:
    """The commit, 40 digits, that a branch or tag stands for."""
    return revision if re.fullmatch(r"[0-9a-f]{40}", revision) else hashlib.sha1(revision.encode()).hexdigest()


class Hub(ThreadingHTTPServer):
    """Holds content by repository, revision and file; notes the method and these of every request."""

    def __init__(self, files: dict[tuple[str, ...], bytes]) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.files, self.asked = files, []
        self.address = f"http://127.0.0.1:{self.server_port}"


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: Hub

    def answer(self) -> bytes:
        key = ADDRESS.fullmatch(self.path).groups()
        self.server.asked.append((self.command, *key))
        content = self.server.files.get(key)
        if content is None:
            kinds = {known[:i] for known in self.server.files for i in (1, 2)}
            missing = "Entry" if key[:2] in kinds else "Revision" if key[:1] in kinds else "Repo"
            headers = {"X-Error-Code": f"{missing}NotFound", "Content-Length": "0"}
        else:
            headers = {"ETag": f'"{hashlib.sha256(content).hexdigest()}"', "X-Repo-Commit": commit(key[1])}
            headers["Content-Length"] = str(len(content))
        self.send_response(404 if content is None else 200)
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        return content or b""

    def do_HEAD(self) -> None:
        self.answer()

    def do_GET(self) -> None:
        self.wfile.write(self.answer())

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture(scope="module")
def hub(make_backend) -> Iterator[Hub]:
    """Publishes two backends; DA3 in two revisions, and a repository without weights."""

    def weights(name: str, seed: int, prefix: str) -> bytes:
        state = make_backend(name, f"seed={seed}").network.state_dict()
        return save({prefix + key: value for key, value in state.items()})

    files = {
        ("someone/da3", name, FILE): weights("da3_tiny", seed, "model.") for name, seed in (("v1", 5), ("main", 6))
    }
    files["someone/vggt", "main", FILE] = weights("vggt_tiny", 7, "")
    files["someone/empty", "main", "README.md"] = b"nothing here"
    server = Hub(files)
    thread = Thread(target=server.serve_forever)
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


def load(cache: Path, settings: dict[str, str], *backends: tuple[str, ...]) -> list[str]:
    """Loads backends in a process that knows no other cache, token or address, and waits for nothing."""
    environment: dict[str, str | None] = {key: None for key in os.environ if key.startswith(("HF_", "HUGGING"))}
    environment |= {"HF_HOME": str(cache), "NO_PROXY": "127.0.0.1", "HF_HUB_DISABLE_TELEMETRY": "1", **settings}
    result = run_python(LOAD, json.dumps(backends), folder=ROOT, environment=environment)
    assert result.returncode == 0, result.stderr[-3000:]
    return json.loads(result.stdout.splitlines()[-1])


DA3 = ("da3_tiny", "pretrained=true", "repo=someone/da3")
VGGT = ("vggt_tiny", "pretrained=true", "repo=someone/vggt")


def test_downloads_what_was_asked_for_and_then_lives_off_the_cache(hub: Hub, make_backend, tmp_path: Path) -> None:
    asked = [(*DA3, "revision=v1"), DA3, VGGT, (*DA3, "revision=v2")]
    nothing = [("da3_tiny", "pretrained=true", "repo=someone/empty")]
    nothing += [("da3_tiny", "pretrained=true", "repo=someone/nobody", "revision=v3")]
    online = load(tmp_path, {"HF_ENDPOINT": hub.address}, *asked, *nothing)
    donors = (("da3_tiny", 5), ("da3_tiny", 6), ("vggt_tiny", 7))
    assert online[:3] == [make_backend(name, f"seed={seed}").identity()["weights"] for name, seed in donors]
    downloaded = [request[1:] for request in hub.asked if request[0] == "GET"]
    assert downloaded == [("someone/da3", "v1", FILE), ("someone/da3", "main", FILE), ("someone/vggt", "main", FILE)]
    for message, where in zip(
        online[3:], ("da3 (revision v2", "empty (revision newest", "nobody (revision v3"), strict=True
    ):
        assert message.startswith(f"FileNotFoundError: cannot get {FILE} of someone/{where})"), message
        assert re.search("backend.path=.*backend.pretrained=false|backend.pretrained=false.*backend.path=", message)
        assert "\n" not in message
    hub.asked.clear()
    offline = load(
        tmp_path, {"HF_ENDPOINT": hub.address, "HF_HUB_OFFLINE": "1"}, *asked, (*DA3, f"revision={commit('v1')}")
    )
    assert offline[:3] + offline[4:] == [*online[:3], online[0]]
    assert offline[3].startswith(f"FileNotFoundError: cannot get {FILE} of someone/da3 (revision v2)")
    assert not hub.asked


def test_an_unreachable_hub_is_one_clear_error(tmp_path: Path) -> None:
    (message,) = load(tmp_path, {"HF_ENDPOINT": "http://127.0.0.1:9"}, VGGT)
    assert message.startswith(f"FileNotFoundError: cannot get {FILE} of someone/vggt (revision newest)")
    assert "Connection refused" in message
    assert "\n" not in message
