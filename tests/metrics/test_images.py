"""PSNR and SSIM against torchmetrics, LPIPS with random weights against the same network written in NumPy."""

from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.lib.stride_tricks import sliding_window_view
from safetensors.torch import save_file
from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

from vg2gt.metrics import LPIPS, WeightsNotFoundError, load_lpips, psnr, ssim
from vg2gt.metrics.images import WEIGHTS_FILE

WIDTHS = dict(
    zip((0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28), (64,) * 2 + (128,) * 2 + (256,) * 3 + (512,) * 6, strict=True)
)
POSITIONS = dict(zip(WIDTHS, (3, *WIDTHS.values()), strict=False))  # and the channels that go in
COMPARED_AFTER = (2, 7, 14, 21, 28)


@pytest.fixture(scope="module")
def features() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    state = {"classifier.6.bias": torch.zeros(3)}
    for position, channels in POSITIONS.items():
        shape = (WIDTHS[position], channels, 3, 3)
        state[f"features.{position}.weight"] = torch.randn(shape, generator=generator) / (9 * channels / 2) ** 0.5
        state[f"features.{position}.bias"] = 0.1 * torch.randn(WIDTHS[position], generator=generator)
    return state


@pytest.fixture(scope="module")
def channel_weights() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    sizes = (64, 128, 256, 512, 512)
    return {f"lin{k}.model.1.weight": torch.rand(1, size, 1, 1, generator=generator) for k, size in enumerate(sizes)}


def numpy_lpips(first: np.ndarray, second: np.ndarray, state: dict[str, torch.Tensor]) -> float:
    """Float64, written from the publication: convolve, rectify, pool; compare after the last layer of each stage."""
    shift, scale = (np.array(v)[:, None, None] for v in ((-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)))
    maps = [(2 * np.clip(image, 0, 1) - 1 - shift) / scale for image in (first, second)]
    total, stage = 0.0, 0
    for position in POSITIONS:
        weight, bias = (state[f"features.{position}.{name}"].double().numpy() for name in ("weight", "bias"))
        for side in (0, 1):
            windows = sliding_window_view(np.pad(maps[side], ((0, 0), (1, 1), (1, 1))), (3, 3), axis=(1, 2))
            convolved = np.einsum("chwij,ocij->ohw", windows, weight, optimize=True) + bias[:, None, None]
            maps[side] = np.maximum(convolved, 0)
        if position in COMPARED_AFTER:
            unit = [m / np.linalg.norm(m, axis=0, keepdims=True) for m in maps]
            lin = state[f"lin{stage}.model.1.weight"].double().numpy()[0]
            total += float((lin * (unit[0] - unit[1]) ** 2).sum(0).mean())
            stage += 1
            maps = [m[:, : m.shape[1] // 2 * 2, : m.shape[2] // 2 * 2] for m in maps]
            maps = [m.reshape(len(m), m.shape[1] // 2, 2, m.shape[2] // 2, 2).max((2, 4)) for m in maps]
    return total


def test_matches_numpy(features, channel_weights) -> None:
    state = {**features, **channel_weights}
    generator = torch.Generator().manual_seed(2)
    first, second = torch.rand(2, 2, 3, 18, 21, generator=generator)
    first = first + 0.3  # some colours beyond 1
    found = LPIPS(state)(first, second)
    assert found.shape == (2,)
    expected = [numpy_lpips(a.double().numpy(), b.double().numpy(), state) for a, b in zip(first, second, strict=True)]
    assert found.tolist() == pytest.approx(expected, rel=1e-4)


def test_weights_from_a_file_and_the_hubs_cache(features, channel_weights, tmp_path, monkeypatch):
    image, other = torch.rand(2, 3, 16, 16, generator=torch.Generator().manual_seed(4))
    expected = float(LPIPS({**features, **channel_weights})(image, other))
    torch.save(features, tmp_path / WEIGHTS_FILE)
    save_file({**features, **channel_weights}, tmp_path / "both.safetensors")
    assert float(load_lpips(str(tmp_path / "both.safetensors"))(image, other)) == expected
    alone = float(load_lpips(str(tmp_path / WEIGHTS_FILE))(image, other))  # with the published channel weights
    assert alone > 0
    assert alone != expected
    hub = tmp_path / "hub"
    (hub / "checkpoints").mkdir(parents=True)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(hub))
    with pytest.raises(WeightsNotFoundError, match=r"evaluation\.lpips=download"):
        load_lpips()
    (tmp_path / WEIGHTS_FILE).rename(hub / "checkpoints" / WEIGHTS_FILE)
    assert float(load_lpips()(image, other)) == alone


def test_missing_and_wrong_weights_are_named(features, channel_weights, tmp_path: Path) -> None:
    for path in (tmp_path / "nowhere.pth", tmp_path):
        with pytest.raises(WeightsNotFoundError, match="weights not found"):
            load_lpips(str(path))
    with pytest.raises(ValueError, match=r"features\.0\.weight.*missing"):
        LPIPS(channel_weights)
    with pytest.raises(ValueError, match=r"features\.5\.bias must have shape \(128,\), got \(3,\)"):
        LPIPS({**features, **channel_weights, "features.5.bias": torch.zeros(3)})
    (tmp_path / "damaged.pth").write_bytes(b"not a checkpoint")
    with pytest.raises(ValueError, match=r"damaged\.pth is damaged"):
        load_lpips(str(tmp_path / "damaged.pth"))


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
