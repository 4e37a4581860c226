"""Reconstructs a scene from photos in Python, step by step: ``python examples/photos_to_scene.py PHOTOS OUT``."""

import sys

from vg2gt import load_model, reconstruct_with
from vg2gt.refinement import RefineOptions, RefineRates

photos, out = sys.argv[1:]

# 1. Load a model: the shipped plane sweep and the head trained on it. load_model("outputs/RUN") loads your own run.
loaded = load_model(backend="sweep")
print(loaded.weights)

# 2. Reconstruct. Cameras come from files next to the photos, or from structure from motion (vg2gt[colmap]).
scene = reconstruct_with(loaded.model, photos, size=280)
print(f"{len(scene.gaussians)} Gaussians from {len(scene.names)} views of {scene.cameras.size}")

# 3. Render: colour [3, H, W] in [0, 1], depth [H, W] in scene units (0 = none), normals in camera axes.
for name, view in zip(scene.names, scene.render(), strict=True):
    known = view.depth > 0
    print(f"{name}: median depth {view.depth[known].median():.2f}" if known.any() else f"{name}: no depth")

# 4. Refine on the same photos, with fixed cameras. Initially keeps only surfaces that two views agree on.
photographs = RefineOptions(steps=100, sh_degree=1, fill=0, min_views=2, rates=RefineRates(means=0.8, cameras=0))
sharper = scene.refine(photographs)

# 5. Save Gaussians for any viewer, cameras and a report image.
sharper.save(out, ["scene.ply", "cameras.json", "report.png"])
