"""What surrounds a scene: a far shell, or nothing around what masks cut out."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import TYPE_CHECKING

import torch

from vg2gt.geometry.cameras import unproject
from vg2gt.inputs.inputs import without_padding
from vg2gt.inputs.pictures import spread
from vg2gt.method.additions.far_shell import far_shell
from vg2gt.method.additions.hull import Meaning, meaning_of, outside_hull
from vg2gt.reconstruction.windows.store import AUTOMATIC

if TYPE_CHECKING:
    from vg2gt.reconstruction.scene import Scene

log = logging.getLogger(__name__)

_VIEWS = 24  # maximum number of views whose masks are compared with the depth of the others
_LEAST_LEFT = 0.1  # share of the Gaussians that masks must leave: otherwise they contradict each other


def with_surroundings(scene: Scene, shell: bool = True) -> Scene:
    """Returns the scene without what its masks show to be empty, and with a far shell for pixels that no view places.

    Around a cut-out object there is no shell. Masks that hide only parts of the scene take nothing away
    (:mod:`vg2gt.method.additions.hull`).

    Args:
        scene: a scene as the model made it.
        shell: whether to add a shell.
    """
    meaning = _meaning(scene)
    scene = _carved(scene, meaning)
    if not shell or meaning.is_object:
        return scene
    some = torch.tensor(spread(len(scene.names), min(len(scene.names), AUTOMATIC)))
    mask = None if scene.mask is None else scene.mask[some]
    far = far_shell(scene.images[some], scene.depth[some], scene.cameras.to("cpu").select(some), mask)
    if far is None:
        return scene
    if meaning.share is not None and scene.mask is not None:
        seen = without_padding(scene.mask)
        far = far.select(~outside_hull(far.means, scene.cameras.to("cpu"), seen, meaning.share))
    return replace(scene, gaussians=scene.gaussians.joined(far.to(scene.gaussians.means.device)))


def without_debris(scene: Scene) -> Scene:
    """Returns the scene without what its masks show to be empty, such as Gaussians that its refinement moved there."""
    return _carved(scene, _meaning(scene))


def _meaning(scene: Scene) -> Meaning:
    if scene.mask is None:
        return Meaning(None, False)
    return meaning_of(scene.depth, scene.cameras.to("cpu"), without_padding(scene.mask))


def _carved(scene: Scene, meaning: Meaning) -> Scene:
    """Returns the scene without Gaussians and depth outside of the masks, if these say that nothing is there."""
    if meaning.share is None or scene.mask is None:
        return scene
    mask = without_padding(scene.mask)
    inside = ~outside_hull(scene.gaussians.means, scene.cameras, mask, meaning.share)
    if inside.float().mean() < _LEAST_LEFT:
        log.warning("the masks of the views contradict each other: nothing is left that all of them show; not applied")
        return scene
    depth, cameras = scene.depth.clone(), scene.cameras.to("cpu")
    some = torch.tensor(spread(len(depth), min(len(depth), _VIEWS)))
    for view, own in enumerate(depth):
        seen = own > 0
        world = unproject(own[None, None], cameras.select(slice(view, view + 1)))[0, 0][seen]
        own[seen] *= ~outside_hull(world, cameras.select(some), mask[some], meaning.share)
    return replace(scene, gaussians=scene.gaussians.select(inside), depth=depth)
