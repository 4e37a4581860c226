"""IterMVS in ``examples/backends`` against the published code, and its own parts against each other."""

import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from backends.weights import load_strictly
from examples.backends.itermvs import IterMVSBackend
from examples.backends.itermvs.depth_range import range_of, wide_range
from examples.backends.itermvs.matching import GROUPS, Hypotheses, Projections, similarity, similarity_reference
from examples.backends.itermvs.network import IterMVSNet
from tests.commands import ROOT
from tests.references import draw_weights, read_cases
from vg2gt.config import compose
from vg2gt.types import Hints

CHECKPOINT = Path(os.environ.get("ITERMVS", ""), "checkpoints/blendedmvs/model_000015.ckpt")


def largest(found: Tensor, expected: Tensor) -> float:
    """Largest difference over largest value."""
    assert found.shape == expected.shape
    return float((found - expected).abs().max() / expected.abs().max())


def run(network: IterMVSNet, case: dict[str, Tensor]) -> dict[str, Tensor]:
    """Hidden states, depth and confidence of ``images`` as they are."""
    projections = Projections.between(case["world_to_camera"], case["intrinsics"], case["sources"].long())
    with torch.no_grad():
        features = network.feature_net(case["images"])
        hidden = network.encode(features, projections, case["depth_range"], 4)
        depth, confidence = network.decode(hidden, features[2], case["depth_range"])
    return {"hidden": hidden, "depth": depth, "confidence": confidence}


def test_equals_the_published_code_in_float64() -> None:
    """With random weights; the stored outputs are rounded to 2^-21 of the largest value."""
    network = IterMVSNet().eval()
    load_strictly(network, draw_weights("itermvs"), "module.", ("module.feature_net.inner3",), "drawn weights")
    case = {name.removeprefix("0."): value.double() for name, value in read_cases("itermvs").items()}
    found = run(network.double(), case)
    assert {name: largest(found[name], case[name]) < 1e-6 for name in found} == dict.fromkeys(found, True)


def test_equals_the_published_weights_and_code(shared: Path) -> None:
    """Bounds of float32: the published code differs from itself in float64 by 2.6e-4, 5e-6 and 2e-5."""
    if not CHECKPOINT.is_file():
        pytest.skip("needs ITERMVS=FOLDER, a checkout of FangjinhuaWang/IterMVS with its checkpoints")
    import numpy as np

    network = IterMVSBackend(path=str(CHECKPOINT)).network
    with np.load(shared / "parity/itermvs/office_5_views.npz", allow_pickle=False) as file:
        case = {name: torch.from_numpy(file[name]) for name in file.files}
    found = run(network, case)
    assert largest(found["depth"], case["depth"]) < 1e-5
    assert largest(found["confidence"], case["confidence"]) < 2e-5
    assert largest(found["hidden"], case["hidden"]) < 2e-4


def test_decoding_has_the_gradient_of_the_mean_over_all_bins() -> None:
    """The most likely bin is chosen without one: enhanced tokens could not move depth beyond the bins around it."""
    update = IterMVSNet().double().iter_mvs.update
    hidden = torch.randn(1, 32, 2, 3, generator=torch.Generator().manual_seed(0)).double()
    chosen = update.position(hidden)
    lifted = hidden.clone().requires_grad_()
    found = update.position(lifted)
    assert torch.allclose(found, chosen, rtol=0, atol=1e-12)
    (gradient,) = torch.autograd.grad(found.sum(), lifted)
    step = 1e-6 * torch.randn(hidden.shape, generator=torch.Generator().manual_seed(1)).double()

    def means(values: Tensor) -> Tensor:
        return (update.depth_head(values).softmax(1) * torch.arange(256.0).view(-1, 1, 1)).sum(1) / 255

    with torch.no_grad():
        local = update.position(hidden + step) - update.position(hidden - step)
        expected = (local.sum() + (means(hidden + step) - means(hidden - step)).sum()) / 2
    assert float((gradient * step).sum()) == pytest.approx(float(expected), rel=1e-4)


@pytest.fixture
def problem(make_scene) -> tuple:
    """Features, projections, hypotheses (some behind the sources or outside) and weights of three views."""
    hints = make_scene(1, 3, (32, 48))[1]
    generator = torch.Generator().manual_seed(1)
    sources = torch.tensor([[1, 2], [0, 2], [1, 0]])
    poses = hints.cameras.world_to_camera[0].clone()
    poses[2, 2, 3] -= 1.0
    projections = Projections.between(poses, hints.cameras.intrinsics[0], sources)
    depth = 0.5 + 4 * torch.rand(3, 5, 8, 12, generator=generator)
    own, features = (torch.randn(3, 2 * GROUPS, *size, generator=generator) for size in ((8, 12), (16, 24)))
    return own, features, projections, Hypotheses(depth, 4, 2), torch.rand(3, 2, 8, 12, generator=generator)


def test_kernel_equals_the_reference(problem) -> None:
    found, expected = similarity(*problem), similarity_reference(*problem)
    assert 0.02 < (expected == 0).float().mean() < 0.6  # some points fall outside of both sources
    assert largest(found, expected) < 1e-5
    assert problem[3].depth[0, 0, 0, 0] > 0


def test_reads_a_checkpoint_that_holds_an_optimiser(tmp_path: Path, capsys) -> None:
    donor = IterMVSBackend(pretrained=False, seed=3)
    state = {f"module.{name}": value for name, value in donor.network.state_dict().items()}
    state["module.feature_net.inner3.weight"] = torch.zeros(1)
    torch.save({"epoch": 15, "model": state, "optimizer": {"state": {}, "param_groups": []}}, tmp_path / "some.ckpt")
    backend = IterMVSBackend(path=str(tmp_path / "some.ckpt"))
    assert "MIT" in capsys.readouterr().out
    weights = [each.network.state_dict()["iter_mvs.update.gru.convz.weight"] for each in (donor, backend)]
    assert torch.equal(*weights)
    with pytest.raises(FileNotFoundError, match=r"itermvs has no published weights: give backend\.path"):
        IterMVSBackend()
    del state["module.feature_net.output2.bias"]
    torch.save({"model": state}, tmp_path / "some.ckpt")
    with pytest.raises(ValueError, match=r"some\.ckpt does not fit IterMVSNet: .*feature_net\.output2\.bias"):
        IterMVSBackend(path=str(tmp_path / "some.ckpt"))


def test_images_are_normalised_and_tokens_are_hidden_states(make_scene) -> None:
    backend = IterMVSBackend(pretrained=False)
    images, hints = make_scene(1, 3, (24, 40))  # 8, but not 32, divides the size
    hints = replace(hints, depth_range=torch.tensor([[1.0, 5.0]]))
    seen = []
    backend.network.feature_net.register_forward_pre_hook(lambda _, given: seen.append(given[0]))
    tokens = backend.encode(images, hints)
    assert torch.equal(seen[0], 2 * images[0] - 1)
    hidden, _ = backend._match(2 * images[0] - 1, backend.decode(tokens).cameras, tokens.state["depth_range"][0])
    assert tokens.patch[0].shape == (1, 3, 15, 128)
    assert torch.equal(tokens.patch[0][0, 1, 7].view(-1, 2, 2), hidden[1, :, 2:4, 4:6])
    depth = backend.decode(tokens).depth
    assert depth.min() >= 1.0
    assert depth.max() <= 5.0


def test_depth_and_found_range_scale_with_the_cameras(make_scene) -> None:
    backend = IterMVSBackend(pretrained=False)
    images, hints = make_scene(1, 4, (24, 40))
    results = []
    for scale in (1.0, 1024.0):
        poses = hints.cameras.world_to_camera.clone()
        poses[..., :3, 3] *= scale
        tokens = backend.encode(images, Hints(cameras=replace(hints.cameras, world_to_camera=poses)))
        results.append((tokens.state["depth_range"] / scale, backend.decode(tokens).depth / scale))
    for small, large in zip(*results, strict=True):
        torch.testing.assert_close(small, large, rtol=1e-4, atol=0)


def test_the_option_composes_and_bad_settings_are_named() -> None:
    search = f"hydra.searchpath=[{ROOT / 'examples/backends/configs'}]"
    config = compose("train", search, "backend=itermvs", "backend.path=FILE").backend
    assert (config._target_, config.path) == ("examples.backends.itermvs.IterMVSBackend", "FILE")
    with pytest.raises(ValueError, match=r"backend\.sources and backend\.iterations"):
        IterMVSBackend(pretrained=False, iterations=0)


def row_of_cameras(views: int, step: float = 0.2) -> Tensor:
    """Cameras side by side that look the same way: ``[V, 4, 4]``."""
    poses = torch.eye(4).repeat(views, 1, 1)
    poses[:, 0, 3] = -step * torch.arange(views)
    return poses


def test_ranges() -> None:
    """Of the first search from the cameras, then from the depths that count."""
    poses = row_of_cameras(4)
    walk = row_of_cameras(21)  # 4 long: something may stand as near as a step
    ranges = torch.stack((wide_range(poses), wide_range(walk)))
    torch.testing.assert_close(ranges, torch.tensor([[0.06, 24.0], [0.2, 160.0]]), rtol=1e-4, atol=0)
    close = row_of_cameras(4, step=1e-4)
    close[0, 0, 3] = 1.0  # and one camera far away
    torch.testing.assert_close(wide_range(close), torch.tensor([0.03, 40.0]), rtol=1e-3, atol=0)
    depth = torch.cat((torch.linspace(2, 4, 1000), torch.full((1000,), 90.0)))
    near = depth < 5
    found = range_of(depth, near, wide_range(poses))
    torch.testing.assert_close(found, torch.tensor([2.02 * 0.8, 3.98 * 1.4]), rtol=1e-2, atol=0)
    assert torch.equal(range_of(depth, near & ~near, wide_range(poses)), wide_range(poses))
