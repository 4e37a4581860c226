"""Shapes, repositories and licences of the networks that backends know by name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import MISSING, dataclass, fields
from typing import Any

from backends.vit import FeedForward


@dataclass(frozen=True, kw_only=True)
class Network:
    """Shape and source of a network; keys that a kind of network does not have keep their default.

    Attributes:
        licence: licence of the weights.
        repo: Hugging Face repository of the weights; None if there is none.
        dim: channels C of the blocks.
        depth: number of blocks (VGGT: pairs of blocks).
        encoder_depth: number of blocks of VGGT's per-view encoder.
        num_heads: attention heads.
        ffn: feed-forward layer.
        multiview_from: first block that relates views; None: none does.
        taps: indices of four blocks (VGGT: pairs of blocks) whose tokens feed the heads, ascending.
        features: channels of the DPT's fusion stages.
        out_channels: DPT channels of the four taps.
        camera_depth: number of blocks of DA3's camera encoder or of VGGT's camera head.
        camera_heads: their attention heads.
        image_size: native image edge.
        patch_size: edge of a patch in pixels.
        prefix: prefix of DA3's names in the file.
    """

    licence: str = "unknown"
    repo: str | None = None
    dim: int
    depth: int
    encoder_depth: int = 24
    num_heads: int
    ffn: FeedForward = "mlp"
    multiview_from: int | None = None
    taps: Sequence[int]
    features: int
    out_channels: Sequence[int]
    camera_depth: int = 4
    camera_heads: int = 16
    image_size: int = 518
    patch_size: int = 14
    prefix: str = "model."


_OPEN, _NC = "Apache-2.0", "CC BY-NC 4.0 (non-commercial)"
_NESTED = "depth-anything/DA3NESTED-GIANT-LARGE-1.1"
_LARGE = {"dim": 1024, "depth": 24, "num_heads": 16, "features": 256, "out_channels": (256, 512, 1024, 1024)}
_GIANT = _LARGE | {
    "licence": _NC, "repo": "depth-anything/DA3-GIANT-1.1", "dim": 1536, "depth": 40, "num_heads": 24,
    "ffn": "swiglu", "multiview_from": 13, "taps": (19, 27, 33, 39),
}  # fmt: skip
_METRIC = _LARGE | {"licence": _OPEN, "repo": "depth-anything/DA3METRIC-LARGE", "taps": (4, 11, 17, 23)}
_BASE = {"dim": 768, "depth": 12, "num_heads": 12, "multiview_from": 4, "taps": (5, 7, 9, 11)}
_TINY = {
    "licence": "none (random weights)", "dim": 48, "num_heads": 3, "features": 24, "out_channels": (16, 20, 28, 32),
    "camera_depth": 1, "camera_heads": 4, "image_size": 70,
}  # fmt: skip

NETWORKS: dict[str, dict[str, Any]] = {
    "da3_small": _BASE | {
        "licence": _OPEN, "repo": "depth-anything/DA3-SMALL", "dim": 384, "num_heads": 6, "features": 64,
        "out_channels": (48, 96, 192, 384),
    },
    "da3_base": _BASE | {
        "licence": _OPEN, "repo": "depth-anything/DA3-BASE", "features": 128, "out_channels": (96, 192, 384, 768),
    },
    "da3_large": _LARGE | {
        "licence": _NC, "repo": "depth-anything/DA3-LARGE-1.1", "multiview_from": 8, "taps": (11, 15, 19, 23),
    },
    "da3_giant": _GIANT,
    "da3_metric_large": _METRIC,
    "da3_nested_giant": _GIANT | {"repo": _NESTED, "prefix": "model.da3."},
    "da3_nested_metric": _METRIC | {"repo": _NESTED, "prefix": "model.da3_metric."},
    "vggt_1b": _LARGE | {
        "licence": "VGGT research licence (https://huggingface.co/facebook/VGGT-1B)", "repo": "facebook/VGGT-1B",
        "taps": (4, 11, 17, 23),
    },
    # for tests and trainer.fast_dev_run
    "da3_tiny": _TINY | {"depth": 8, "multiview_from": 2, "taps": (1, 3, 5, 7)},
    "vggt_tiny": _TINY | {"depth": 4, "encoder_depth": 2, "taps": (0, 1, 2, 3)},
}  # fmt: skip


def network_named(name: str, given: dict[str, Any]) -> Network:
    """Returns the network of a name in :data:`NETWORKS`, with ``given`` instead of its attributes.

    Raises:
        ValueError: if the name is unknown and ``given`` does not have all of a network's shape.
    """
    known = NETWORKS.get(name, {}) | given
    if missing := [each.name for each in fields(Network) if each.default is MISSING and each.name not in known]:
        raise ValueError(f"backend.name={name} is none of {', '.join(NETWORKS)}: give its {', '.join(missing)}, too")
    return Network(**known)
