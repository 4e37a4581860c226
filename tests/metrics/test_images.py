import pytest
import torch
from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

from vg2gt.metrics import psnr, ssim


@pytest.fixture
def images() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    reference = torch.rand(4, 3, 30, 37, generator=generator)
    noise = torch.randn(reference.shape, generator=generator)
    return (reference + torch.linspace(0.02, 0.3, 4)[:, None, None, None] * noise), reference


def test_psnr_of_each_image_with_clamped_colours(images) -> None:
    predicted, reference = images
    found = psnr(predicted, reference)
    assert found.shape == (4,)
    for index in range(4):
        expected = peak_signal_noise_ratio(predicted[index].clamp(0, 1), reference[index], data_range=1.0)
        assert float(found[index]) == pytest.approx(float(expected), rel=1e-5)
    assert psnr(reference + 10, torch.ones_like(reference)).isinf().all()


def test_ssim_matches_torchmetrics_where_the_window_lies_inside_the_image(images) -> None:
    predicted, reference = images
    found = ssim(predicted, reference)
    _, full = structural_similarity_index_measure(
        predicted.clamp(0, 1), reference, sigma=1.5, data_range=1.0, reduction="none", return_full_image=True
    )
    expected = full[..., 5:-5, 5:-5].mean((1, 2, 3))
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)
    assert (found.diff() < 0).all()
