import math
from itertools import combinations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.geometry.test_cameras import random_cameras
from vg2gt.metrics import camera_metrics, relative_pose_errors
from vg2gt.types import Cameras


def test_errors_of_all_pairs_match_brute_force() -> None:
    predicted, reference = random_cameras(views=4), random_cameras(views=4, seed=1)
    rotation, translation = relative_pose_errors(predicted, reference)
    for scene in range(2):
        for pair, (i, j) in enumerate(combinations(range(4), 2)):
            poses = (cameras.world_to_camera[scene].numpy() for cameras in (predicted, reference))
            one, two = (pose[j] @ np.linalg.inv(pose[i]) for pose in poses)
            turn = Rotation.from_matrix(one[:3, :3].T @ two[:3, :3]).magnitude()
            a, b = one[:3, 3], two[:3, 3]
            angle = math.acos(abs(a @ b) / np.linalg.norm(a) / np.linalg.norm(b))
            assert float(rotation[scene, pair]) == pytest.approx(math.degrees(turn), rel=1e-9)
            assert float(translation[scene, pair]) == pytest.approx(math.degrees(angle), rel=1e-9)


def test_known_turn_and_known_direction() -> None:
    poses = torch.eye(4, dtype=torch.float64).repeat(1, 2, 1, 1)
    poses[0, 1, :3, 3] = torch.tensor([1.0, 0, 0])
    reference = Cameras(poses, torch.eye(3, dtype=torch.float64).repeat(1, 2, 1, 1), (4, 4))
    other = poses.clone()
    other[0, 1, :3, :3] = torch.from_numpy(Rotation.from_euler("y", 4.5, degrees=True).as_matrix())
    direction = math.radians(10.5)
    other[0, 1, :3, 3] = -5 * torch.tensor([math.cos(direction), math.sin(direction), 0])  # opposite: counts as equal
    predicted = Cameras(other, reference.intrinsics, (4, 4))
    rotation, translation = relative_pose_errors(predicted, reference)
    assert [float(rotation), float(translation)] == pytest.approx([4.5, 10.5])
    found = camera_metrics(predicted, reference)
    assert [found[name] for name in ("rra_5", "rta_5", "rta_15", "auc_3", "auc_5")] == [1, 0, 1, 0, 0]
    # below 11, 12, 13, 14 and 15 degrees
    assert [found["auc_15"], found["auc_30"]] == pytest.approx([5 / 15, 20 / 30])


def test_cameras_that_turn_in_one_place_have_no_direction_wherever_that_is() -> None:
    turns = Rotation.from_rotvec(np.random.default_rng(1).normal(size=(5, 3))).as_matrix()

    def cameras(centers: np.ndarray) -> Cameras:
        poses = np.tile(np.eye(4), (5, 1, 1))
        poses[:, :3, :3] = turns
        poses[:, :3, 3] = -np.einsum("nij,nj->ni", turns, centers)
        return Cameras(torch.tensor(poses[None], dtype=torch.float32), torch.eye(3).repeat(1, 5, 1, 1), (4, 4))

    still, moving = cameras(np.tile([100.0, 50, 3], (5, 1))), cameras(np.random.default_rng(0).normal(size=(5, 3)))
    assert float(relative_pose_errors(moving, still)[1].max()) == 0
    assert float(relative_pose_errors(still, moving)[1].min()) == 90
