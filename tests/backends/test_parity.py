"""Our networks against outputs of the official code at tiny sizes with random weights."""

import dataclasses
import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from backends.da3 import DA3Backend, DA3MetricBackend
from backends.da3.metric import fill_sky
from backends.vggt import VGGTBackend
from vg2gt.types import Cameras, Hints, Tokens

TOLERANCE = 2e-5
VGGT_CASES = (0, 1, 2)
DA3_CASES = [("da3_tiny_mlp", case) for case in range(7)] + [("da3_tiny_swiglu", case) for case in range(2)]


class Fixture:
    """One case of a fixture folder; compares by largest difference over largest reference value."""

    def __init__(self, folder: Path, case: int) -> None:
        self.folder = str(folder)
        settings = json.loads((folder / "config.json").read_text())
        self.config, self.case = settings["config"], settings["cases"][case]
        prefix = f"case{case}."
        tensors = load_file(folder / "io.safetensors")
        self.tensors = {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}

    def __getitem__(self, key: str) -> Tensor:
        return self.tensors[key]

    def __contains__(self, key: str) -> bool:
        return key in self.tensors

    def check(self, key: str, value: Tensor) -> None:
        expected = self.tensors[key]
        assert value.shape == expected.shape, key
        error = (value - expected).abs().max() / expected.abs().max()
        assert error <= TOLERANCE, f"{key}: {error:.2e}"


def vggt(fixture: Fixture) -> VGGTBackend:
    config = fixture.config
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
        path=fixture.folder,
        head_chunk=2,
    )


def da3(fixture: Fixture) -> DA3Backend:
    net, head, encoder = (fixture.config[part] for part in ("net", "head", "cam_enc"))
    return DA3Backend(
        name="da3_parity",
        licence="none",
        dim=net["embed_dim"],
        depth=net["depth"],
        num_heads=net["num_heads"],
        multiview_from=net["alt_start"],
        taps=net["out_layers"],
        features=head["features"],
        out_channels=head["out_channels"],
        ffn="swiglu" if net["ffn_layer"].startswith("swiglu") else "mlp",
        camera_depth=encoder["trunk_depth"],
        camera_heads=encoder["num_heads"],
        image_size=net["img_size"],
        reference_view=fixture.case.get("ref", "saddle_balanced"),
        given_poses="posed" in fixture.case,
        path=fixture.folder,
        head_chunk=2,
    )


def metric(fixture: Fixture) -> DA3MetricBackend:
    net, head = fixture.config["net"], fixture.config["head"]
    return DA3MetricBackend(
        name="da3_metric_parity",
        licence="none",
        dim=net["embed_dim"],
        depth=net["depth"],
        num_heads=net["num_heads"],
        taps=net["out_layers"],
        features=head["features"],
        out_channels=head["out_channels"],
        image_size=net["img_size"],
        path=fixture.folder,
    )


@pytest.mark.parametrize("case", VGGT_CASES)
def test_vggt(shared: Path, case: int) -> None:
    fixture = Fixture(shared / "parity" / "vggt_tiny", case)
    backend = vggt(fixture)
    tokens = backend.encode(fixture["images"])
    special = fixture["tokens.0"].shape[2] - tokens.patch[0].shape[2]
    expected = [fixture[f"tokens.{tap}"] for tap in range(4)]
    for tap, reference in enumerate(expected):
        fixture.tensors[f"patch.{tap}"] = reference[:, :, special:]
        fixture.check(f"patch.{tap}", tokens.patch[tap])
    fixture.tensors["camera"] = expected[-1][:, :, 0]
    fixture.check("camera", tokens.camera)
    check_vggt_geometry(fixture, backend, tokens, "")
    if "redecode.depth" in fixture:
        deltas = [fixture[f"redecode.delta.{tap}"] for tap in range(4)]
        patch = tuple(patch + delta[:, :, special:] for patch, delta in zip(tokens.patch, deltas, strict=True))
        changed = dataclasses.replace(tokens, patch=patch, camera=tokens.camera + deltas[-1][:, :, 0])
        check_vggt_geometry(fixture, backend, changed, "redecode.")


def check_vggt_geometry(fixture: Fixture, backend: VGGTBackend, tokens: Tokens, prefix: str) -> None:
    geometry = backend.decode(tokens)
    fixture.check(prefix + "depth", geometry.depth[..., None])
    fixture.check(prefix + "depth_conf", geometry.depth_conf)
    fixture.check(prefix + "pose_enc", backend.network.camera_head(tokens.camera))
    fixture.check(prefix + "extrinsics", geometry.cameras.world_to_camera[..., :3, :])
    fixture.check(prefix + "intrinsics", geometry.cameras.intrinsics)


@pytest.mark.parametrize(("name", "case"), DA3_CASES)
def test_da3(shared: Path, name: str, case: int) -> None:
    fixture = Fixture(shared / "parity" / name, case)
    backend = da3(fixture)
    images = fixture["images"]
    if backend.given_poses:
        # The reference fed these cameras as they are; encode() would first normalise them.
        cameras = Cameras(fixture["in_extrinsics_w2c"], fixture["in_intrinsics"], (images.shape[-2], images.shape[-1]))
        assert backend.network.cam_enc is not None
        given = backend.network.cam_enc(cameras)
        fixture.check("cam_token_in", given)
        tokens = backend.encode_with(images, given)
    else:
        tokens = backend.encode(images)
    for tap in range(4):
        if f"tokens.{tap}" in fixture:
            fixture.check(f"tokens.{tap}", tokens.patch[tap])
    fixture.check("cam_tokens.3", tokens.camera)
    check_da3_geometry(fixture, backend, tokens, "")
    if "redecode.depth" in fixture:
        patch = tuple(patch + fixture[f"redecode.delta.{tap}"] for tap, patch in enumerate(tokens.patch))
        camera = tokens.camera + fixture["redecode.delta_cam.3"]
        check_da3_geometry(fixture, backend, dataclasses.replace(tokens, patch=patch, camera=camera), "redecode.")


def check_da3_geometry(fixture: Fixture, backend: DA3Backend, tokens: Tokens, prefix: str) -> None:
    geometry = backend.decode(tokens)
    fixture.check(prefix + "depth", geometry.depth)
    fixture.check(prefix + "depth_conf", geometry.depth_conf)
    fixture.check(prefix + "pose_enc", backend.network.cam_dec(tokens.camera))
    fixture.check(prefix + "extrinsics", geometry.cameras.world_to_camera[..., :3, :])
    fixture.check(prefix + "intrinsics", geometry.cameras.intrinsics)


@pytest.mark.parametrize("case", [0, 1])
def test_da3_metric(shared: Path, case: int) -> None:
    fixture = Fixture(shared / "parity" / "da3_tiny_metric", case)
    backend = metric(fixture)
    images = fixture["images"]
    intrinsics = torch.diag(torch.tensor([450.0, 150.0, 1.0])).repeat(*images.shape[:2], 1, 1)
    cameras = Cameras(torch.eye(4).repeat(*images.shape[:2], 1, 1), intrinsics, (images.shape[-2], images.shape[-1]))
    tokens = backend.encode(images, Hints(cameras=cameras))
    for tap in range(4):
        fixture.check(f"tokens.{tap}", tokens.patch[tap])
    fixture.check("cam_tokens.3", tokens.camera)
    depth, sky = backend.decode_raw(tokens)
    fixture.check("depth", depth)
    torch.testing.assert_close(sky, fixture["sky"], rtol=TOLERANCE, atol=TOLERANCE)  # all zero in one case
    fixture.check("depth_after_sky", fill_sky(depth, sky))
    geometry = backend.decode(tokens)
    fixture.check("depth_after_sky", geometry.depth)  # the mean focal length is 300
    assert torch.equal(geometry.depth_conf, torch.ones_like(geometry.depth))
