"""Weights through the real ``huggingface_hub`` client, from a hub in miniature on this machine.

The client reads its settings when it is imported, so every setting gets a process of its own.
"""

import hashlib
import json
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import pytest
from safetensors.torch import save

from tests.commands import ROOT, run_python

pytest.importorskip("huggingface_hub")

ADDRESS = re.compile(r"/(?P<repo>[^/]+/[^/]+)/resolve/(?P<revision>[^/]+)/(?P<file>.+)")

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


@dataclass
class Hub:
    """What the hub holds and what it was asked for."""

    files: dict[tuple[str, str, str], bytes] = field(default_factory=dict)
    asked: list[tuple[str, str, str, str]] = field(default_factory=list)
    address: str = ""


def commit(revision: str) -> str:
    """The commit, 40 digits, that a branch or tag stands for."""
    return revision if re.fullmatch(r"[0-9a-f]{40}", revision) else hashlib.sha1(revision.encode()).hexdigest()


def handler(hub: Hub) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def answer(self) -> bytes:
            match = ADDRESS.fullmatch(self.path)
            assert match, self.path
            key = (match["repo"], match["revision"], match["file"])
            hub.asked.append((self.command, *key))
            content = hub.files.get(key)
            if content is None:
                known_repo = any(repo == key[0] for repo, _, _ in hub.files)
                known_revision = any(known[:2] == key[:2] for known in hub.files)
                self.send_response(404)
                self.send_header(
                    "X-Error-Code",
                    "EntryNotFound" if known_revision else "RevisionNotFound" if known_repo else "RepoNotFound",
                )
                content = b""
            else:
                self.send_response(200)
                self.send_header("ETag", f'"{hashlib.sha256(content).hexdigest()}"')
                self.send_header("X-Repo-Commit", commit(key[1]))
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            return content

        def do_HEAD(self) -> None:
            self.answer()

        def do_GET(self) -> None:
            self.wfile.write(self.answer())

        def log_message(self, format: str, *args: object) -> None:
            pass

    return Handler


@pytest.fixture(scope="module")
def hub(make_backend) -> Iterator[Hub]:
    """Publishes two backends; DA3 in two revisions, and a repository without weights."""
    hub = Hub()
    for revision, seed in (("v1", 5), ("main", 6)):
        network = make_backend("da3_tiny", f"seed={seed}").network
        state = {f"model.{key}": value for key, value in network.state_dict().items()}
        hub.files["someone/da3", revision, "model.safetensors"] = save(state)
    state = make_backend("vggt_tiny", "seed=7").network.state_dict()
    hub.files["someone/vggt", "main", "model.safetensors"] = save(state)
    hub.files["someone/empty", "main", "README.md"] = b"nothing here"
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler(hub))
    hub.address = f"http://127.0.0.1:{server.server_port}"
    thread = Thread(target=server.serve_forever)
    thread.start()
    yield hub
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
    hub.asked.clear()
    online = load(
        tmp_path,
        {"HF_ENDPOINT": hub.address},
        (*DA3, "revision=v1"),
        DA3,
        VGGT,
        (*DA3, "revision=v2"),
        ("da3_tiny", "pretrained=true", "repo=someone/empty"),
        ("da3_tiny", "pretrained=true", "repo=someone/nobody", "revision=v3"),
    )
    donors = (("da3_tiny", 5), ("da3_tiny", 6), ("vggt_tiny", 7))
    assert online[:3] == [make_backend(name, f"seed={seed}").identity()["weights"] for name, seed in donors]
    downloaded = [request[1:] for request in hub.asked if request[0] == "GET"]
    file = "model.safetensors"
    assert downloaded == [("someone/da3", "v1", file), ("someone/da3", "main", file), ("someone/vggt", "main", file)]
    for message, repo, revision in zip(
        online[3:], ("someone/da3", "someone/empty", "someone/nobody"), ("v2", "newest", "v3"), strict=True
    ):
        assert message.startswith(f"FileNotFoundError: cannot get {file} of {repo} (revision {revision})"), message
        assert "backend.pretrained=false" in message
        assert "backend.path=" in message
        assert "\n" not in message
    hub.asked.clear()
    offline = load(
        tmp_path,
        {"HF_ENDPOINT": hub.address, "HF_HUB_OFFLINE": "1"},
        (*DA3, "revision=v1"),
        DA3,
        (*DA3, f"revision={commit('v1')}"),
        VGGT,
        (*DA3, "revision=v2"),
    )
    assert offline[:4] == [online[0], online[1], online[0], online[2]]
    assert offline[4].startswith(f"FileNotFoundError: cannot get {file} of someone/da3 (revision v2)")
    assert not hub.asked


def test_an_unreachable_hub_is_one_clear_error(tmp_path: Path) -> None:
    (message,) = load(tmp_path, {"HF_ENDPOINT": "http://127.0.0.1:9"}, VGGT)
    assert message.startswith("FileNotFoundError: cannot get model.safetensors of someone/vggt (revision newest)")
    assert "Connection refused" in message
    assert "backend.pretrained=false" in message
    assert "\n" not in message
