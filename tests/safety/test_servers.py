"""The viewer's server: this machine only, its own page only, nothing from the disk."""

import base64
import http.client
import importlib.util
import os
from collections.abc import Iterator

import pytest

from tests.io.gaussian_scenes import scene
from vg2gt.viewer import ViewerScene, start_server
from vg2gt.viewer.server import is_own_request

OWN = [
    (["127.0.0.1:8080"], []),
    (["localhost:8080"], []),
    (["[::1]:8080"], ["http://[::1]:8080"]),
    (["192.168.1.7:8080"], ["http://192.168.1.7:8080"]),  # --host 0.0.0.0
]
FOREIGN = [
    (["evil.example:8080"], []),  # a name that leads to 127.0.0.1
    (["127.0.0.1.evil.example:8080"], []),
    (["127.0.0.1:8080"], ["http://evil.example"]),  # another page in the same browser
    (["127.0.0.1:8080"], ["http://127.0.0.1:9999"]),
    (["127.0.0.1:8080"], ["null"]),  # a file, or a frame in a sandbox
    (["127.0.0.1:8080"], ["http://127.0.0.1:8080", "http://evil.example"]),
    (["127.0.0.1:8080", "evil.example"], []),
    ([], []),
    (["[::1"], []),
]


def test_the_page_itself_may_ask_and_other_pages_may_not() -> None:
    for requests, own in ((OWN, True), (FOREIGN, False)):
        for hosts, origins in requests:
            assert is_own_request(hosts, origins) is own, (hosts, origins)


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    if importlib.util.find_spec("viser") is None:
        pytest.skip("needs viser: pip install viser")
    running = start_server(ViewerScene(scene(5)), port=0)
    yield running.get_port()
    running.stop()


def ask(port: int, path: str = "/", **headers: str) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    connection.putrequest("GET", path, skip_host=True)
    for name, value in {"Host": f"127.0.0.1:{port}", **headers}.items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    content = b"" if answer.status == http.client.SWITCHING_PROTOCOLS else answer.read()
    connection.close()
    return answer.status, content


def test_the_server_asks_who_asks(port: int) -> None:
    assert (ask(port)[0], ask(port, Host="evil.example")[0]) == (200, 403)
    assert ask(port, Origin="http://evil.example")[0] == 403
    import viser  # pyright: ignore[reportMissingImports]

    asked = {"Key": base64.b64encode(os.urandom(16)).decode(), "Version": "13"}
    asked["Protocol"] = f"viser-v{viser.__version__}"
    socket = {f"Sec-WebSocket-{name}": value for name, value in asked.items()}
    socket |= {"Upgrade": "websocket", "Connection": "Upgrade"}
    assert ask(port, Origin=f"http://127.0.0.1:{port}", **socket)[0] == 101
    assert ask(port, Origin="http://evil.example", **socket)[0] == 403
    assert ask(port, Host="evil.example", **socket)[0] == 403


@pytest.mark.parametrize(
    "path",
    [
        "/../../../../../../../../etc/passwd",
        "/%2e%2e/%2e%2e/%2e%2e/%2e%2e/%2e%2e/%2e%2e/etc/passwd",
        "/..%2f..%2f..%2f..%2f..%2f..%2fetc/passwd",
        "/..%5c..%5c..%5cetc%5cpasswd",
        "//etc/passwd",
        "/assets",
        "/assets/",
        "/.",
        "/%00",
    ],
)
def test_nothing_but_the_page_is_served(port: int, path: str) -> None:
    status, content = ask(port, path)
    assert b"root:" not in content
    assert status in (404, 500) or b"<html" in content.lower()
