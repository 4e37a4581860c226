"""A reconstructed scene: Gaussians, the cameras of the views, and the images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vg2gt.geometry.cameras import unproject
from vg2gt.inputs.camera_source import CameraSource
from vg2gt.inputs.inputs import photo_of
from vg2gt.inputs.pictures import Picture
from vg2gt.io.cameras_json import NamedCamera, named_cameras
from vg2gt.reconstruction.frame import SceneFrame, move_to_target, moved_cameras
from vg2gt.refinement import Refined, RefineOptions
from vg2gt.rendering import Renderer
from vg2gt.types import Cameras, Gaussians
from vg2gt.visibility import point_support

if TYPE_CHECKING:
    from vg2gt.reconstruction.policy import Quality

POINTS = 100_000


@dataclass(frozen=True)
class RenderedView:
    """One rendered view on the CPU.

    Attributes:
        camera: camera it was rendered with.
        color: ``[3, H, W]`` in [0, 1], over the scene's background.
        depth: ``[H, W]`` z-depth in scene units, 0 = none.
        normal: ``[3, H, W]`` in the camera's frame, not unit length.
        alpha: ``[H, W]`` opacity in [0, 1].
    """

    camera: NamedCamera
    color: Tensor
    depth: Tensor
    normal: Tensor
    alpha: Tensor


@dataclass(frozen=True)
class ScenePoints:
    """Coloured points of a scene, each with the view it comes from.

    Attributes:
        positions: ``[N, 3]`` float64 in the world frame.
        colors: ``[N, 3]`` uint8.
        views: ``[N]`` index of the view.
    """

    positions: NDArray[np.float64]
    colors: NDArray[np.uint8]
    views: NDArray[np.int64]


@dataclass(frozen=True)
class Scene:
    """A reconstructed scene, as :meth:`vg2gt.api.Pipeline.reconstruct` returns it.

    The world frame and unit are those of the given cameras, or else the reference camera turned upright (x right, y
    down, z forward), with a median depth of about 1.

    Attributes:
        gaussians: Gaussians of the scene, on the device where it was made.
        cameras: ``[1, V]`` cameras of the views, for images of the working size.
        images: ``[V, 3, H, W]`` in [0, 1]: the input at the working size.
        depth: ``[V, H, W]`` decoded z-depth in scene units, 0 = none.
        depth_conf: ``[V, H, W]`` its confidence, larger is better.
        names: one per view.
        renderer: renderer of the scene.
        metres_per_unit: metres per scene unit; None if unknown.
        refined: result of the refinement; None if not refined.
        cameras_from: source of the cameras given to the backbone; empty if it predicted them.
        frame: placement of the world in that of the given or found cameras; None if unknown.
        mask: ``[V, H, W]`` in [0, 1], weights of the input pixels; None: all count.
        pictures: source pictures, one per view; empty for a scene read from files.
        error: ``[V, H, W]`` bound e that holds in 9 of 10 pixels: decoded and true depth differ by a factor of at most
            1 + e; infinite without a measured depth. None: not stated.
        support: ``[V, H, W]`` uint8 :class:`vg2gt.visibility.Status` of each pixel; None: unknown.
        poses: ``[V, 4, 4]`` float64 ``world_to_camera``, if known more precisely than in ``cameras``.
        is_object: whether the surroundings were cut off (:meth:`cut_to_object`), so that meshes are closed.
    """

    gaussians: Gaussians
    cameras: Cameras
    images: Tensor
    depth: Tensor
    depth_conf: Tensor
    names: tuple[str, ...]
    renderer: Renderer
    metres_per_unit: float | None = None
    cameras_from: str = ""
    refined: Refined | None = None
    frame: SceneFrame | None = None
    mask: Tensor | None = None
    pictures: tuple[Picture, ...] = ()
    poses: Tensor | None = None
    error: Tensor | None = None
    support: Tensor | None = None
    is_object: bool = False

    @property
    def camera_source(self) -> CameraSource:
        """Kind of origin of the cameras."""
        return CameraSource.of(self.cameras_from)

    @cached_property
    def gaussian_trust(self) -> dict[str, Tensor] | None:
        """``support`` (:class:`vg2gt.visibility.Status`) and, if stated, ``error`` of the Gaussians, ``[G]`` each.

        None if the support of the pixels is unknown.
        """
        if self.support is None:
            return None
        device = self.gaussians.means.device
        error = None if self.error is None else self.error.to(device)
        status, bound = point_support(self.gaussians.means, self.depth.to(device), self.cameras.to(device), error)
        known = {"support": status.cpu()}
        return known if error is None else {"error": bound.cpu(), **known}

    def named_cameras(self) -> list[NamedCamera]:
        """Returns the views' cameras, named like the image files that :meth:`save` writes."""
        named = named_cameras(self.cameras, [f"{name}.png" for name in self.names])
        if self.poses is not None and torch.equal(self.poses.float(), self.cameras.world_to_camera[0].cpu().float()):
            named = [replace(c, world_to_camera=pose.numpy()) for c, pose in zip(named, self.poses, strict=True)]
        if self.frame is None:
            return named
        named = [replace(c, similarity=self.frame.to_source, metres_per_unit=self.metres_per_unit) for c in named]
        if not self.pictures:
            return named
        return [replace(c, photo=photo_of(c, picture)) for c, picture in zip(named, self.pictures, strict=True)]

    def placed(self) -> Scene:
        """Returns the scene in its target frame and unit (``frame.target``)."""
        if self.frame is None or self.frame.name == self.frame.target:
            return self
        depth = self.depth[self.depth > 0]
        frame, move = move_to_target(self.frame, self.cameras, float(depth.median()) if len(depth) else 1.0)
        cameras, poses = moved_cameras(self.cameras, move, frame)
        scale = float(move.scale)
        return replace(
            self,
            gaussians=move.apply_gaussians(self.gaussians),
            cameras=cameras,
            depth=self.depth * scale,
            metres_per_unit=None if self.metres_per_unit is None else self.metres_per_unit / scale,
            renderer=replace(self.renderer, near=self.renderer.near * min(scale, 1.0)),
            frame=frame,
            poses=poses,
        )

    def render(self, cameras: Sequence[NamedCamera] | None = None) -> Iterator[RenderedView]:
        """Renders views one by one, to bound memory; None: the input views."""
        return render_views(self.renderer, self.gaussians, self.named_cameras() if cameras is None else cameras)

    def points(self) -> ScenePoints:
        """Returns points of the decoded depth on a regular grid of pixels, about 100,000 or fewer."""
        step = max(1, int(np.ceil(np.sqrt(self.depth.numel() / POINTS))))
        grid = (slice(None), slice(step // 2, None, step), slice(step // 2, None, step))
        world = unproject(self.depth[None].double(), self.cameras.to("cpu").map(Tensor.double))[0]
        keep = self.depth[grid] > 0
        colors = (self.images.permute(0, 2, 3, 1)[grid][keep] * 255 + 0.5).to(torch.uint8)
        return ScenePoints(world[grid][keep].numpy(), colors.numpy(), keep.nonzero()[:, 0].numpy())

    def refine(self, options: RefineOptions | None = None, quality: Quality = "normal", **changes: Any) -> Scene:
        """Optimises Gaussians and cameras on the scene's own images (:func:`vg2gt.refinement.refine`).

        Args:
            options: options of the refinement; None: those of the scene's kind of input, as ``vg2gt refine`` chooses
                them (:func:`vg2gt.reconstruction.policy.refinement_for`).
            quality: how long photographs are refined, if no options are given.
            **changes: options to override, such as ``steps=50`` or ``holdout=8``.

        Returns:
            The refined scene; this one is not changed.
        """
        from vg2gt.reconstruction.policy import refinement_for
        from vg2gt.reconstruction.refined import refine_scene

        return refine_scene(self, replace(options or refinement_for(self, quality, **changes), **changes))

    def cut_to_object(self) -> Scene:
        """Returns the scene without what surrounds the object that its cameras look at.

        Raises:
            ValueError: if they do not look at one place.
        """
        from vg2gt.reconstruction.cutout import cut_to_object

        return cut_to_object(self)

    def save(
        self,
        folder: str | Path,
        outputs: Sequence[str] = ("scene.ply", "cameras.json", "report.png"),
        *,
        overwrite: bool = False,
    ) -> Path:
        """Writes outputs into a folder; :data:`vg2gt.outputs.output_names.OUTPUTS` lists them.

        Args:
            folder: output folder, created if missing.
            outputs: names of the outputs. ``scene.html`` is a page that shows the scene in a browser.
            overwrite: replace existing outputs.

        Returns:
            The folder.

        Raises:
            FileExistsError: if an output exists and ``overwrite`` is false.
            ValueError: if an output is unknown.
        """
        from vg2gt.outputs.outputs import write_outputs

        return write_outputs(self, folder, outputs, overwrite=overwrite)


@torch.no_grad()
def render_views(renderer: Renderer, gaussians: Gaussians, cameras: Sequence[NamedCamera]) -> Iterator[RenderedView]:
    """Renders one scene into cameras of any sizes, one by one."""
    device = gaussians.means.device
    for camera in cameras:
        image = renderer(gaussians, camera.cameras().to(device)).to("cpu")
        yield RenderedView(
            camera, image.color[0, 0].clamp(0, 1), image.depth[0, 0], image.normal[0, 0], image.alpha[0, 0]
        )
