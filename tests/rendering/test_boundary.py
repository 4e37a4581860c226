"""Degenerate scenes, refused input, and the configured renderer."""

from dataclasses import replace

import pytest
import torch

from tests.rendering.scenes import IMPLEMENTATIONS, cameras_around, floats_to, images, pinhole, soup, with_gradients
from vg2gt.rendering import Renderer, render
from vg2gt.rendering.options import Mode, RenderOptions
from vg2gt.rendering.renderer import Implementation
from vg2gt.types import Cameras, Gaussians, Render

MODES: tuple[Mode, ...] = ("solid", "rasterized")


def assert_sound(gaussians: Gaussians, cameras: Cameras, implementation: Implementation, mode: Mode) -> torch.Tensor:
    """Renders; every image and gradient must be finite; returns alpha."""
    gaussians = with_gradients(gaussians)
    out = render(gaussians, cameras, mode, (0.2, 0.4, 0.6), implementation=implementation)
    assert out.color.shape == (*cameras.world_to_camera.shape[:2], 3, *cameras.size)
    assert all(torch.isfinite(image).all() for image in images(out))
    inputs = [gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh]
    total = torch.stack([image.sum() for image in images(out)]).sum()
    assert all(torch.isfinite(g).all() for g in torch.autograd.grad(total, inputs))
    return out.alpha


def assert_background(gaussians: Gaussians, implementation: Implementation, mode: Mode) -> None:
    out = render(gaussians, pinhole((5, 7)), mode, (0.2, 0.4, 0.6), implementation=implementation)
    expected = torch.tensor([0.2, 0.4, 0.6], dtype=out.color.dtype)[None, None, :, None, None].expand_as(out.color)
    torch.testing.assert_close(out.color, expected, rtol=0, atol=0)
    assert not out.alpha.any()
    assert not out.depth.any()
    assert not out.normal.any()


UNSEEN = {
    "none": soup(0),
    "behind the camera": replace(soup(20), means=-soup(20).means),
    "beside the image": replace(soup(20, size=0.01), means=soup(20).means + torch.tensor([500.0, 0.0, 0.0])),
    "transparent": replace(soup(20), opacities=torch.zeros(20).double()),
}


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
class TestDegenerateScenes:
    @pytest.mark.parametrize("gaussians", UNSEEN.values(), ids=UNSEEN)
    def test_nothing_to_see(self, implementation: Implementation, mode: Mode, gaussians: Gaussians) -> None:
        assert_background(gaussians, implementation, mode)

    def test_straddling_the_camera(self, implementation: Implementation, mode: Mode) -> None:
        gaussians = soup(30)
        near = gaussians.means * torch.tensor([1.0, 1.0, 0.05])
        assert_sound(replace(gaussians, means=near), pinhole((6, 9)), implementation, mode)

    @pytest.mark.parametrize("scale", [1e-8, 1e8])
    def test_tiny_and_huge_scales(self, implementation: Implementation, mode: Mode, scale: float) -> None:
        gaussians = floats_to(soup(20), torch.float32)
        gaussians.scales[::2] *= scale
        assert_sound(gaussians, pinhole((6, 9)).map(torch.Tensor.float), implementation, mode)

    @pytest.mark.parametrize("size", [(1, 1), (3, 50), (17, 33)])
    @pytest.mark.parametrize("focal", [(30.0, 28.0), (8.0, 40.0)])
    def test_any_image_size_and_focal_lengths(self, implementation: Implementation, mode: Mode, size, focal) -> None:
        gaussians, cameras = soup(40, size=0.3), pinhole(size, focal)
        alpha = assert_sound(gaussians, cameras, implementation, mode)
        reference = render(gaussians, cameras, mode, implementation="dense").alpha
        torch.testing.assert_close(alpha, reference, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("means", float("nan")),
        ("quats", float("inf")),
        ("scales", 0.0),
        ("scales", -1.0),
        ("opacities", 1.5),
        ("sh", float("nan")),
    ],
)
def test_bad_values_are_refused_by_name(name: str, value: float) -> None:
    gaussians = soup(5)
    getattr(gaussians, name)[3] = value
    with pytest.raises(ValueError, match=rf"^{name} .*\[3"):
        render(gaussians, pinhole((4, 4)))


def test_bad_cameras_are_refused_by_name() -> None:
    cameras = pinhole((4, 4))
    with pytest.raises(ValueError, match=r"^world_to_camera holds"):
        render(soup(5), Cameras(cameras.world_to_camera * float("nan"), cameras.intrinsics, (4, 4)))
    with pytest.raises(ValueError, match=r"^intrinsics must be"):
        render(soup(5), Cameras(cameras.world_to_camera, -cameras.intrinsics, (4, 4)))
    with pytest.raises(ValueError, match=r"^world_to_camera must be"):
        render(soup(5), Cameras(cameras.world_to_camera[0], cameras.intrinsics, (4, 4)))


def test_bad_shapes_and_order_are_refused() -> None:
    gaussians = soup(5)
    with pytest.raises(ValueError, match=r"opacities must be \[5\]"):
        render(replace(gaussians, opacities=gaussians.opacities[:, None]), pinhole((4, 4)))
    with pytest.raises(ValueError, match=r"sh must be"):
        render(replace(gaussians, sh=gaussians.sh[:, 0]), pinhole((4, 4)))
    with pytest.raises(ValueError, match=r"batch must be sorted"):
        render(replace(gaussians, batch=gaussians.batch + 1), pinhole((4, 4)))


@pytest.mark.parametrize(
    "options",
    [{"mode": "gaussian"}, {"depth": "expected"}, {"near": 0.0}, {"alpha_max": 1.0}, {"implementation": "gpu"}],
)
def test_bad_options_are_refused(options: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"depth|mode|near|alpha_max|implementation"):
        Renderer(**options)  # type: ignore[arg-type]


def two_scenes() -> tuple[Gaussians, Cameras]:
    """Two scenes of 20 Gaussians in two views each, each with a background of its own."""
    colors = torch.tensor([[1.0, 0.5, 0.0], [0.1, 0.2, 0.9]], dtype=torch.float64)
    return replace(soup(20, scenes=2), background=colors), cameras_around((9, 12), scenes=2)


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_every_scene_has_its_own_background_unless_one_is_given(implementation: Implementation) -> None:
    gaussians, cameras = two_scenes()
    out = render(gaussians, cameras, implementation=implementation)
    for scene, color in enumerate(gaussians.background):
        alone = render(gaussians.scene(scene), cameras.scene(scene), implementation=implementation)
        given = render(gaussians, cameras, background=color, implementation=implementation)
        torch.testing.assert_close(out.color[scene], alone.color[0])
        torch.testing.assert_close(out.color[scene], given.color[scene])
    assert (out.color - render(replace(gaussians, background=None), cameras).color).abs().max() > 0.1


def test_the_kernels_that_know_one_background_get_each_scenes_own(monkeypatch: pytest.MonkeyPatch) -> None:
    gpu = pytest.importorskip("vg2gt.rendering.gpu_tiles", exc_type=ImportError)
    gaussians, cameras = two_scenes()
    monkeypatch.setattr("vg2gt.rendering.renderer._resolve", lambda *_: "triton")

    def stand_in(gaussians: Gaussians, cameras: Cameras, background: torch.Tensor, *_: RenderOptions, **__) -> Render:
        assert background.shape == (3,)
        with monkeypatch.context() as patch:
            patch.setattr("vg2gt.rendering.renderer._resolve", lambda *_: "dense")
            return render(gaussians, cameras, background=background)

    monkeypatch.setattr(gpu, "render_triton", stand_in)
    found = render(gaussians, cameras).color
    monkeypatch.undo()
    torch.testing.assert_close(found, render(gaussians, cameras, implementation="dense").color)
