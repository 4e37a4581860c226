import math

import torch
from scipy.spatial.transform import Rotation

from vg2gt.geometry.rotations import matrix_to_quat, multiply_quats, quat_to_matrix


def random_quats(count: int) -> torch.Tensor:
    return torch.randn(count, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def test_rotations_are_scipys_and_come_back_up_to_sign() -> None:
    quats = random_quats(200)
    matrices = quat_to_matrix(quats)
    expected = Rotation.from_quat(quats[:, [1, 2, 3, 0]].numpy()).as_matrix()
    torch.testing.assert_close(matrices, torch.from_numpy(expected))
    back = matrix_to_quat(matrices)
    assert (back[:, 0] >= 0).all()
    unit = torch.nn.functional.normalize(quats, dim=-1)
    torch.testing.assert_close(back, unit * torch.where(unit[:, :1] < 0, -1.0, 1.0))


def test_half_turns_are_safe() -> None:
    """Turns by pi have w = 0: the square root of the trace is of no use there."""
    for axis in ((1, 0, 0), (0, 1, 0), (0, 0, 1), (0.6, 0.0, -0.8), (-0.48, 0.6, 0.64)):
        for angle in (math.pi, math.pi - 1e-7):
            quat = [math.cos(angle / 2), *(math.sin(angle / 2) * a for a in axis)]
            matrix = quat_to_matrix(torch.tensor(quat, dtype=torch.float64))
            torch.testing.assert_close(quat_to_matrix(matrix_to_quat(matrix)), matrix, rtol=1e-9, atol=1e-9)


def test_gradients_are_finite_at_the_identity() -> None:
    matrix = torch.eye(3, dtype=torch.float64).requires_grad_()
    matrix_to_quat(matrix).sum().backward()
    assert torch.isfinite(matrix.grad).all()


def test_product_of_quaternions_is_the_product_of_rotations() -> None:
    one, two = torch.nn.functional.normalize(random_quats(40), dim=-1).chunk(2)
    product = quat_to_matrix(multiply_quats(one, two))
    assert torch.allclose(product, quat_to_matrix(one) @ quat_to_matrix(two), atol=1e-12)
