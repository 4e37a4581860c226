"""Reconstructs a scene from photos in Python, step by step: ``python examples/photos_to_scene.py PHOTOS OUT``."""

import sys

import vg2gt

photos, out = sys.argv[1:]

# 1. Load a model: the weights in the package. vg2gt.load("outputs/RUN") loads your own run.
model = vg2gt.load()
print(model.weights)

# 2. Reconstruct. Cameras come from files next to the photos, or from structure from motion (vg2gt[colmap]).
scene = model.reconstruct(photos, size=280, refine=False)
print(f"{len(scene.gaussians)} Gaussians from {len(scene.names)} views of {scene.cameras.size}")

# 3. Render: colour [3, H, W] in [0, 1], depth [H, W] in scene units (0 = none), normals in camera axes.
for name, view in zip(scene.names, scene.render(), strict=True):
    known = view.depth > 0
    print(f"{name}: median depth {view.depth[known].median():.2f}" if known.any() else f"{name}: no depth")

# 4. Refine on the same photos. Without refine=False, step 2 does this for up to 100 photos.
sharper = scene.refine(steps=100)

# 5. Save Gaussians for any viewer, cameras, and a page to look at the scene in a browser.
sharper.save(out, ["scene.ply", "cameras.json", "scene.html"], overwrite=True)
