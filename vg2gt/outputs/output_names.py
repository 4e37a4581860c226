"""Names of the outputs of a scene. Imports nothing, so that a command's help is fast."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

FPS = 24.0

MAPS = {
    "color.png": "rendered colour, a PNG per view in color/",
    "depth.npy": "rendered depth, a float32 array per view in depth/, scene units, 0 = none",
    "normals.npy": "rendered normals, a float32 array [3, H, W] per view in normals/, the camera's frame",
}

OUTPUTS = {
    "scene.ply": "the Gaussians, as 3D Gaussian Splatting writes them, with error and support",
    "scene.spz": "the same, about 16 bytes each (Niantic's SPZ, version 3)",
    "scene.glb": "the same as glTF (KHR_gaussian_splatting), full precision",
    "scene.gltf": "the same as one JSON file",
    "scene.spz.glb": "glTF with an SPZ of version 2 inside (KHR_gaussian_splatting_compression_spz_2, a draft)",
    "scene.html": "a page that shows the scene in a browser, as vg2gt view writes it",
    "tiles": "the same split into regions, SPZ files and index.json in tiles/; default above a million Gaussians",
    "cameras.json": "the cameras of the views",
    "points.ply": "coloured points of the decoded depth",
    "views.npz": "input images at the working size, decoded depth, confidence, error, support: what vg2gt refine needs",
    **MAPS,
    "mesh.ply": "a mesh fused from rendered depth",
    "mesh.glb": "the same as GLB",
    "colmap": "a COLMAP model in colmap/ with the photographs, undistorted, at their own size and by their own names",
    "nerfstudio": "transforms.json, points and images in nerfstudio/, as for colmap",
    "report.png": "input, colour, depth, normals and stated error of up to 12 views",
    "report.json": "the run's figures: backend, weights, sizes, time per stage, peak memory",
}
TILES, LARGE = "tiles", 1_000_000  # the command adds tiles if there are more Gaussians
DEFAULT = ("scene.ply", "cameras.json", "views.npz", "report.png", "report.json")
PREDICTED = "predicted by the backbone"  # entry for such cameras in a report


def check_outputs(outputs: Sequence[str], known: Mapping[str, str] = OUTPUTS) -> None:
    """Checks names of outputs.

    Raises:
        ValueError: if a name is unknown or the list is empty; the message lists the known names.
    """
    for output in outputs or [""]:
        if output not in known:
            raise ValueError(f"unknown output {output!r}; choose from: {', '.join(known)}")
