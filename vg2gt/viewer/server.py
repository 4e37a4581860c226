"""Serves a scene to the browser with a viser server on this machine."""

from __future__ import annotations

import importlib.util
import ipaddress
import math
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import torch

from vg2gt.geometry.rotations import matrix_to_quat, quat_to_matrix
from vg2gt.geometry.spherical_harmonics import DC
from vg2gt.io.cameras_json import NamedCamera, invert_pose
from vg2gt.types import Gaussians
from vg2gt.viewer.content import ViewerScene

if TYPE_CHECKING:
    import viser  # pyright: ignore[reportMissingImports]  # optional

LOOPBACK = "127.0.0.1"
PORT = 8080
_LOOK_DEPTHS = 25.0  # distance from a camera to the point to orbit around, in frustum depths


def require_viser() -> None:
    """Raises ImportError, naming the remedy, if viser is not installed."""
    if importlib.util.find_spec("viser") is None:
        raise ImportError(
            "the live viewer requires viser: pip install 'vg2gt[view]'; or use --html to write a standalone page"
        )


def start_server(scene: ViewerScene, host: str = LOOPBACK, port: int = PORT, share: bool = False) -> viser.ViserServer:
    """Serves the scene until ``stop()`` is called on the returned server; colours are limited to SH degree 0.

    viser's page has a button that publishes the scene through an external server. It does nothing unless ``share`` is
    True. Without ``share``, requests from other pages in the same browser are refused, even if their host name
    resolves to this machine.

    Args:
        scene: scene to show; not changed.
        host: address to listen on; the default can be reached from this machine only.
        port: the first port to try; if it is taken, a later free one is used (``get_port()``). 0: any.
        share: whether the scene may be published with ``request_share_url()``.

    Raises:
        ImportError: if viser is not installed; the message names the extra to install.
    """
    require_viser()
    import viser  # pyright: ignore[reportMissingImports]  # optional

    class Server(viser.ViserServer):
        """Server that publishes the scene only with ``share``."""

        def request_share_url(self, verbose: bool = True) -> str | None:
            """Returns the public address, or None without ``share``."""
            return super().request_share_url(verbose) if share else None

    with _refusing_other_pages(share):
        server = Server(host=host, port=port, label=scene.title, verbose=False)
    try:
        _fill(server, scene)
    except BaseException:
        server.stop()
        raise
    return server


def is_own_request(hosts: list[str], origins: list[str]) -> bool:
    """Whether a request comes from the served page, or directly from its user.

    Args:
        hosts: the ``Host`` headers. An IP address, ``localhost`` or this machine's name is accepted; other names may be
            an attacker's that resolve to this machine (DNS rebinding).
        origins: the ``Origin`` headers, which browsers send with a page's requests. The page's own host, or no header,
            is accepted.
    """
    if len(hosts) != 1 or len(origins) > 1:
        return False
    try:
        name = urlsplit(f"//{hosts[0]}").hostname or ""
    except ValueError:
        return False
    if name not in ("localhost", socket.gethostname().lower(), socket.getfqdn().lower()):
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return False
    return all(origin in (f"http://{hosts[0]}", f"https://{hosts[0]}") for origin in origins)


@contextmanager
def _refusing_other_pages(share: bool) -> Iterator[None]:
    """Makes viser servers started inside the block refuse requests that fail :func:`is_own_request`."""
    from websockets.asyncio import server  # pyright: ignore[reportMissingImports]  # viser's

    serve = server.serve

    def guarded(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            headers = request.headers
            if share or is_own_request(headers.get_all("Host"), headers.get_all("Origin")):
                return process_request(connection, request)
            return connection.respond(HTTPStatus.FORBIDDEN, "forbidden: request from another page\n")

        return serve(*arguments, process_request=check, **options)

    server.serve = guarded
    try:
        yield
    finally:
        server.serve = serve


def _fill(server: viser.ViserServer, scene: ViewerScene) -> None:
    server.scene.set_up_direction("-y")
    _add_gaussians(server, scene.gaussians)
    depth = scene.frustum_depth()
    pose = invert_pose(scene.initial().world_to_camera)
    server.initial_camera.position = pose[:3, 3]
    server.initial_camera.look_at = pose[:3, 3] + _LOOK_DEPTHS * depth * pose[:3, 2]
    server.initial_camera.up = -pose[:3, 1]
    server.initial_camera.fov = _field_of_view(scene.initial())
    if scene.cameras:
        _add_cameras(server, scene, depth)


def _add_cameras(server: viser.ViserServer, scene: ViewerScene, depth: float) -> None:
    """Adds frusta with their images, checkboxes that hide either, and a dropdown of cameras to look through."""
    poses = [invert_pose(camera.world_to_camera) for camera in scene.cameras]
    frusta = [
        server.scene.add_camera_frustum(
            f"/cameras/{index}",  # not the name: a slash in it would make a parent node
            fov=_field_of_view(camera),
            aspect=camera.width / camera.height,
            scale=depth,
            image=scene.picture(index),
            wxyz=matrix_to_quat(torch.from_numpy(pose[:3, :3])).numpy(),
            position=pose[:3, 3],
            color=(255, 184, 51),
        )
        for index, (camera, pose) in enumerate(zip(scene.cameras, poses, strict=True))
    ]
    pictured = any(scene.picture(index) is not None for index in range(len(frusta)))
    names = [f"{index}: {camera.name}" for index, camera in enumerate(scene.cameras)]
    show_cameras = server.gui.add_checkbox("Cameras", True)
    show_images = server.gui.add_checkbox("Images", pictured, disabled=not pictured)
    chosen = server.gui.add_dropdown("Look through", names)

    @show_cameras.on_update
    def _(_: Any) -> None:
        for frustum in frusta:
            frustum.visible = show_cameras.value

    @show_images.on_update
    def _(_: Any) -> None:
        for index, frustum in enumerate(frusta):
            frustum.image = scene.picture(index) if show_images.value else None

    @chosen.on_update
    def _(event: Any) -> None:
        if event.client is not None:
            index = names.index(chosen.value)
            pose = poses[index]
            with event.client.atomic():
                event.client.camera.up_direction = -pose[:3, 1]
                event.client.camera.position = pose[:3, 3]
                event.client.camera.look_at = pose[:3, 3] + _LOOK_DEPTHS * depth * pose[:3, 2]
                event.client.camera.fov = _field_of_view(scene.cameras[index])


def _field_of_view(camera: NamedCamera) -> float:
    """Returns the vertical field of view in radians; viser assumes a centred principal point."""
    return 2 * math.atan(camera.height / 2 / float(camera.intrinsics[1, 1]))


def _add_gaussians(server: viser.ViserServer, gaussians: Gaussians) -> None:
    gaussians = gaussians.map(lambda tensor: tensor.detach().cpu())
    scaled = quat_to_matrix(gaussians.quats) * gaussians.scales[:, None, :]
    server.scene.add_gaussian_splats(
        "/gaussians",
        centers=gaussians.means.float().numpy(),
        covariances=(scaled @ scaled.transpose(1, 2)).float().numpy(),
        rgbs=(0.5 + DC * gaussians.sh[:, 0]).clamp(0, 1).float().numpy(),
        opacities=gaussians.opacities[:, None].float().numpy(),
    )
