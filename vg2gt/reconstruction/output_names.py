"""Names of the outputs of a scene. Imports nothing, so that a command's help is fast."""

ORBIT_FRAMES, FPS = 72, 24.0
SFM = "sfm"  # subfolder of the output folder for cameras found by structure from motion
WINDOWS = "windows"  # subfolder of the output folder for a reconstruction in windows

MAPS = {
    "color.png": "rendered colour, a PNG per view in color/",
    "depth.png": "rendered depth, a 16-bit PNG per view in depth/: thousandths of the scene unit, 0 = none",
    "depth.npy": "rendered depth, a float32 array per view in depth/, scene units, 0 = none",
    "normals.png": "rendered normals, a coloured PNG per view in normals/",
    "normals.npy": "rendered normals, a float32 array [3, H, W] per view in normals/, the camera's frame",
}

OUTPUTS = {
    "scene.ply": "the Gaussians, as 3D Gaussian Splatting writes them, with error and support",
    "scene.spz": "the same, about 16 bytes each (Niantic's SPZ, version 3)",
    "tiles": "the same split into regions, SPZ files and index.json in tiles/; default above a million Gaussians",
    "cameras.json": "the cameras of the views",
    "points.ply": "coloured points of the decoded depth",
    "points.glb": "the same points and the cameras, for any 3D viewer",
    "views.npz": "input images at the working size, decoded depth, confidence, error, support: what vg2gt refine needs",
    "images": "the input images at the working size, PNGs in images/",
    **MAPS,
    "mesh.ply": "a mesh fused from rendered depth",
    "mesh.glb": "the same as GLB",
    "mesh.obj": "the same as OBJ",
    "orbit.gif": "an animation that orbits around the central view",
    "orbit.mp4": "the same as H.264",
    "colmap": "a COLMAP model in colmap/ with the photographs, undistorted, at their own size and by their own names",
    "colmap-small": "the same with the images at the working size, in colmap-small/",
    "nerfstudio": "transforms.json, points and images in nerfstudio/, as for colmap",
    "nerfstudio-small": "the same with the images at the working size, in nerfstudio-small/",
    "report.png": "input, colour, depth, normals and stated error of up to 12 views",
    "report.html": "the same of all views, with the run's figures",
    "report.json": "the run's figures: backend, weights, sizes, time per stage, peak memory",
}
TILES, LARGE = "tiles", 1_000_000  # the command adds tiles if there are more Gaussians
DEFAULT = ("scene.ply", "cameras.json", "views.npz", "report.png", "report.json")
PREDICTED = "predicted by the backbone"  # entry for such cameras in a report
REFINED = "refine.png"  # written for every refined scene: views before and after
