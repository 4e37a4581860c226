"""Databases of matches as COLMAP writes them, made from known points instead of photographs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

SIZE, FOCAL = (480, 640), 700.0
FACES = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])


@dataclass(frozen=True)
class Dots:
    """Points ``[N, 3]`` with normals; those of equal labels look alike."""

    positions: NDArray[np.float64]
    normals: NDArray[np.float64]
    labels: NDArray[np.int64]

    def joined(self, other: "Dots") -> "Dots":
        parts = zip(
            (self.positions, self.normals, self.labels), (other.positions, other.normals, other.labels), strict=True
        )
        return Dots(*(np.concatenate(pair) for pair in parts))


def box(sides: Sequence[int], count: int = 220) -> Dots:
    """The four sides of a box; sides of equal numbers look alike."""
    dots = []
    for normal, side in zip(FACES, sides, strict=True):
        flat = np.random.default_rng(side).uniform(-0.8, 0.8, (count, 2))
        across = np.cross([0, 0, 1], normal)
        places = 0.8 * normal + flat[:, :1] * across + flat[:, 1:] * [0, 0, 1] + [0, 0, 0.8]
        dots.append(Dots(places, np.tile(normal, (count, 1)), 1000 * side + np.arange(count)))
    return dots[0].joined(dots[1]).joined(dots[2]).joined(dots[3])


def floor(count: int = 900) -> Dots:
    """The ground around the box, all different."""
    noise = np.random.default_rng(7)
    places = noise.uniform(-2.5, 2.5, (count, 3)) * [1, 1, 0]
    places = places[np.abs(places).max(1) > 0.85]
    return Dots(places, np.tile([0.0, 0, 1], (len(places), 1)), 1_000_000 + np.arange(len(places)))


def orbit(count: int, radius: float = 3.4, height: float = 1.8, turn: float = 360) -> NDArray[np.float64]:
    """Poses ``world_to_camera [count, 4, 4]`` around the z axis, looking at the box."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose, angle in zip(poses, np.radians(10 + np.arange(count) * turn / count), strict=True):
        center = np.array([radius * np.cos(angle), radius * np.sin(angle), height])
        forward = np.array([0, 0, 0.6]) - center
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1]) / np.linalg.norm(np.cross(forward, [0, 0, 1]))
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
        pose[:3, 3] = -pose[:3, :3] @ center
    return poses


def write_database(
    path: Path,
    poses: NDArray[np.float64],
    dots: Dots,
    detected: float = 0.7,
    hidden: Callable[[int], NDArray[np.bool_]] | None = None,
    lens: tuple[float, NDArray[np.float64]] = (FOCAL, np.zeros(2)),
    given: float = FOCAL,
    own: bool = False,
) -> list[str]:
    """Writes features and verified matches of all pairs of images; returns the images' names.

    Args:
        path: the database; the pairs are listed in ``pairs.txt`` next to it.
        poses: ``world_to_camera [V, 4, 4]``.
        dots: what is seen from its front side.
        detected: share of the visible points that are features.
        hidden: returns which points are hidden in a view.
        lens: true focal length, and how far its centre ``[2]`` or ``[V, 2]`` is from the middle of the images.
        given: focal length that the images are said to have; 0: none.
        own: each image has a camera of its own.
    """
    import pycolmap

    noise, names, labels, sights = np.random.default_rng(3), [], [], []
    with pycolmap.Database.open(path) as database:
        cameras = []
        for _ in poses if own else poses[:1]:
            known = [given or 1.2 * SIZE[1], SIZE[1] / 2, SIZE[0] / 2, 0]
            camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=SIZE[1], height=SIZE[0], params=known)
            camera.has_prior_focal_length = given > 0
            camera.camera_id = database.write_camera(camera)
            rig = pycolmap.Rig()
            rig.add_ref_sensor(camera.sensor_id)
            cameras.append((camera.camera_id, database.write_rig(rig)))
        middles = np.broadcast_to(np.array(SIZE[::-1]) / 2 + lens[1], (len(poses), 2))
        for number, pose in enumerate(poses):
            inside = dots.positions @ pose[:3, :3].T + pose[:3, 3]
            pixels = inside[:, :2] / inside[:, 2:] * lens[0] + middles[number]
            sight = -pose[:3, :3].T @ pose[:3, 3] - dots.positions
            facing = (sight * dots.normals).sum(1) / np.linalg.norm(sight, axis=1)
            seen = (facing > 0.25) & (pixels > 0).all(1) & (pixels < SIZE[::-1]).all(1) & (inside[:, 2] > 0)
            seen &= noise.uniform(size=len(seen)) < detected
            if hidden is not None:
                seen &= ~hidden(number)
            camera_id, rig_id = cameras[number if own else 0]
            image = pycolmap.Image(name=f"{number:06d}.jpg", camera_id=camera_id)
            image.image_id = database.write_image(image)
            frame = pycolmap.Frame()
            frame.rig_id = rig_id
            frame.add_data_id(image.data_id)
            database.write_frame(frame)
            places = pixels[seen] + noise.normal(0, 0.4, (int(seen.sum()), 2))
            database.write_keypoints(image.image_id, places.astype(np.float32))
            names.append(image.name)
            labels.append(dots.labels[seen])
            sights.append((sight / np.linalg.norm(sight, axis=1, keepdims=True))[seen])
            normals = dots.normals[seen]
            upwards = np.where(np.abs(normals[:, 2:]) > 0.5, [[0.0, 1, 0]], [[0.0, 0, 1]])
            axes = np.stack([np.cross(upwards, normals), upwards, normals], 1)
            sights[-1] = np.einsum("nij,nj->ni", axes, sights[-1])  # in the axes of the surface, as its look is
        pairs = []
        for later in range(len(poses)):
            for before in range(later):
                _, one, other = np.intersect1d(labels[before], labels[later], return_indices=True)
                near = (sights[before][one] * sights[later][other]).sum(1) > np.cos(np.radians(38))
                matches = np.stack([one, other], 1)[near & (noise.uniform(size=len(near)) < 0.9)]
                if len(matches) >= 15:
                    database.write_matches(before + 1, later + 1, matches.astype(np.uint32))
                    pairs.append(f"{names[before]} {names[later]}\n")
    (path.parent / "pairs.txt").write_text("".join(pairs))
    pycolmap.verify_matches(path, path.parent / "pairs.txt")
    return names
