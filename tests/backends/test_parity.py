"""Our networks against outputs of the official code at tiny sizes with random weights."""

import dataclasses
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

from backends.da3 import DA3Backend, DA3MetricBackend
from backends.da3.metric import fill_sky
from backends.network import normalize_images
from backends.vggt import VGGTBackend
from tests.references import draw_weights, read_cases, read_json
from vg2gt.baselines import DA3Gaussians
from vg2gt.geometry.rotations import quat_to_matrix
from vg2gt.geometry.spherical_harmonics import rotation_of_coefficients
from vg2gt.model import SceneScale
from vg2gt.types import Cameras, Hints, Tokens

TOLERANCE = 2e-5
CASES = [("vggt_tiny", case) for case in range(3)]
CASES += [("da3_tiny_mlp", case) for case in (0, 1, 2, 4, 5, 6)] + [("da3_tiny_swiglu", case) for case in range(2)]


class Reference:
    """One case of a network; compares by largest difference over largest reference value."""

    def __init__(self, network: str, case: int) -> None:
        description = read_json("networks")[network]
        self.config, self.case = description["config"], description["cases"][case]
        tensors = read_cases(network)
        self.images = tensors.get(f"{self.case.get('images_of', case)}.images", torch.empty(0))
        prefix = f"{case}."
        self.tensors = {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}

    def check(self, key: str, value: Tensor) -> None:
        expected = self.tensors[key]
        assert value.shape == expected.shape, key
        error = (value - expected).abs().max() / expected.abs().max()
        assert error <= TOLERANCE, f"{key}: {error:.2e}"

    def check_tokens(self, tokens: Tokens) -> None:
        for tap, patch in enumerate(tokens.patch):
            if f"patch.{tap}" in self.tensors:
                self.check(f"patch.{tap}", patch)
        self.check("camera", tokens.camera)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], str]:
    """Writes a network's weights into a folder, once."""
    root = tmp_path_factory.mktemp("weights")

    @cache
    def folder(network: str) -> str:
        (root / network).mkdir()
        save_file(draw_weights(network), root / network / "model.safetensors")
        return str(root / network)

    return folder


def vggt(config: dict[str, Any], path: str) -> VGGTBackend:
    return VGGTBackend(
        name="vggt_parity",
        dim=config["embed_dim"],
        depth=config["depth"],
        encoder_depth=config["vit_depth"],
        num_heads=config["num_heads"],
        taps=config["intermediate_layer_idx"],
        features=config["dpt_features"],
        out_channels=config["dpt_out_channels"],
        camera_depth=config["camera_trunk_depth"],
        camera_heads=config["camera_num_heads"],
        image_size=config["img_size"],
        path=path,
        head_chunk=2,
    )


def da3_sizes(config: dict[str, Any]) -> dict[str, Any]:
    """What the multi-view and the single-view networks share."""
    net, head = config["net"], config["head"]
    return {
        "name": "da3_parity",
        "licence": "none",
        "dim": net["embed_dim"],
        "depth": net["depth"],
        "num_heads": net["num_heads"],
        "taps": net["out_layers"],
        "features": head["features"],
        "out_channels": head["out_channels"],
        "image_size": net["img_size"],
    }


def da3(config: dict[str, Any], case: dict[str, Any], path: str) -> DA3Backend:
    net, encoder = config["net"], config["cam_enc"]
    return DA3Backend(
        **da3_sizes(config),
        multiview_from=net["alt_start"],
        ffn="swiglu" if net["ffn_layer"].startswith("swiglu") else "mlp",
        camera_depth=encoder["trunk_depth"],
        camera_heads=encoder["num_heads"],
        reference_view=case.get("ref", "saddle_balanced"),
        given_poses="posed" in case,
        path=path,
        head_chunk=2,
    )


@pytest.mark.parametrize(("network", "case"), CASES)
def test_multi_view(weights: Callable[[str], str], network: str, case: int) -> None:
    reference = Reference(network, case)
    config, folder, images = reference.config, weights(network), reference.images
    backend = vggt(config, folder) if network == "vggt_tiny" else da3(config, reference.case, folder)
    if isinstance(backend, DA3Backend) and backend.needs_hints:
        # The reference fed these cameras as they are; encode() would first normalise them.
        size = (images.shape[-2], images.shape[-1])
        cameras = Cameras(reference.tensors["in_extrinsics_w2c"], reference.tensors["in_intrinsics"], size)
        given = backend.network.cam_enc(cameras)
        reference.check("given", given)
        backbone, normalised = backend.network.backbone["pretrained"], normalize_images(images)
        tokens = backend.as_tokens(images, *backbone(normalised, backend.taps, backend.reference_view, given))
    else:
        tokens = backend.encode(images)
    reference.check_tokens(tokens)
    check_geometry(reference, backend, tokens, "")
    if "redecode.depth" in reference.tensors:
        patch = tuple(patch + reference.tensors[f"delta.{tap}"] for tap, patch in enumerate(tokens.patch))
        changed = dataclasses.replace(tokens, patch=patch, camera=tokens.camera + reference.tensors["delta_camera"])
        check_geometry(reference, backend, changed, "redecode.")


def check_geometry(reference: Reference, backend: VGGTBackend | DA3Backend, tokens: Tokens, prefix: str) -> None:
    geometry = backend.decode(tokens)
    head = backend.network.cam_dec if isinstance(backend, DA3Backend) else backend.network.camera_head
    reference.check(prefix + "depth", geometry.depth)
    reference.check(prefix + "depth_conf", geometry.depth_conf)
    reference.check(prefix + "pose_enc", head(tokens.camera))
    reference.check(prefix + "extrinsics", geometry.cameras.world_to_camera[..., :3, :])
    reference.check(prefix + "intrinsics", geometry.cameras.intrinsics)


@pytest.mark.parametrize("case", [0, 1])
def test_gaussians(tmp_path: Path, case: int) -> None:
    """From images to every 41st Gaussian of a scene, brought from the frame of the first view to the network's."""
    reference, gaussians = Reference("da3_tiny_swiglu", case), Reference("da3_tiny_gs", case)
    weights = draw_weights("da3_tiny_swiglu") | draw_weights("da3_tiny_gs")
    save_file(weights, tmp_path / "model.safetensors")
    backend = da3(reference.config, {}, str(tmp_path))
    model = DA3Gaussians(backend, SceneScale("normalize", median_depth=2.0))
    prediction = model(reference.images)
    found, scenes = prediction.gaussians, len(reference.images)
    unit, frame = prediction.unit[found.batch], reference.tensors["extrinsics"][:, 0][found.batch]
    rotation, translation = frame[..., :3], frame[..., 3]
    means = (found.means / unit[:, None] - translation)[:, None] @ rotation
    turned = rotation.mT @ quat_to_matrix(found.quats)
    turns = rotation_of_coefficients(reference.tensors["extrinsics"][:, 0, :, :3].mT, 2)[found.batch]
    gaussians.check("means", every(means[:, 0], scenes))
    gaussians.check("harmonics", every((turns @ found.sh).mT, scenes))
    gaussians.check("opacities", every(found.opacities, scenes))
    scales, rotations = gaussians.tensors["scales"], gaussians.tensors["rotations"]  # signs of both mean nothing
    gaussians.tensors |= {"scales": scales.abs(), "rotations": quat_to_matrix(rotations)}
    gaussians.check("scales", every(found.scales / unit[:, None], scenes))
    gaussians.check("rotations", every(turned, scenes))
    height, width = reference.images.shape[-2:]
    for cameras in (prediction.geometry.cameras, model.predict_cameras(reference.images, None)):
        assert cameras.intrinsics[0, 0, :2, 2].tolist() == [(width - 1) / 2, (height - 1) / 2]


def every(rows: Tensor, scenes: int) -> Tensor:
    """Every 41st Gaussian of each scene."""
    return rows.unflatten(0, (scenes, -1))[:, ::41]


@pytest.mark.parametrize("case", [0, 1])
def test_single_view(weights: Callable[[str], str], case: int) -> None:
    reference = Reference("da3_tiny_metric", case)
    backend = DA3MetricBackend(**da3_sizes(reference.config), path=weights("da3_tiny_metric"))
    images = reference.images
    intrinsics = torch.diag(torch.tensor([450.0, 150.0, 1.0])).repeat(*images.shape[:2], 1, 1)
    cameras = Cameras(torch.eye(4).repeat(*images.shape[:2], 1, 1), intrinsics, (images.shape[-2], images.shape[-1]))
    tokens = backend.encode(images, Hints(cameras=cameras))
    reference.check_tokens(tokens)
    depth, sky = backend.decode_raw(tokens)
    reference.check("depth", depth)
    torch.testing.assert_close(sky, reference.tensors["sky"], rtol=TOLERANCE, atol=TOLERANCE)  # all zero in one case
    reference.check("depth_after_sky", fill_sky(depth, sky))
    geometry = backend.decode(tokens)
    reference.check("depth_after_sky", geometry.depth)  # the mean focal length is 300
    assert torch.equal(geometry.depth_conf, torch.ones_like(geometry.depth))
