"""Camera estimation by structure from motion: COLMAP's incremental mapper from pycolmap (``vg2gt[colmap]``).

All pairs of up to 60 photographs are matched. With more, each is matched with some earlier ones in the given order, at
doubling distances (neighbours on a walk have little baseline), and with those that look alike by VLAD vectors (Jegou et
al. 2010) of SIFT features. Their vocabulary is built from the photographs, so that none has to be downloaded.

The result is kept in a folder that every command reads as a COLMAP recording: undistorted ``images/``, ``masks/`` if
there are masks, a model of PINHOLE cameras in ``sparse/``, and ``sfm.json``, which identifies the input pictures.
COLMAP's SIMPLE_RADIAL lens model (one radial coefficient) is fitted and the images are undistorted with it, because a
pinhole model fitted to a distorted lens gets a wrong focal length.
"""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from vg2gt.data.sources.colmap_model import COLMAP, model_folder_of
from vg2gt.data.sources.masks import mask_beside
from vg2gt.data.transforms import reduce_to_fit, to_bytes
from vg2gt.inputs.distinct import digest
from vg2gt.inputs.folds import unfold
from vg2gt.inputs.given_cameras import LAYOUTS, SFM_STATE
from vg2gt.inputs.lenses import Lenses, is_centre_found, lens_texts, with_right_lenses
from vg2gt.inputs.likely_pairs import descriptors_of, likely_pairs
from vg2gt.inputs.motion import check_motion, check_parallax, why_not_placed
from vg2gt.inputs.pair_evidence import Matches
from vg2gt.inputs.pictures import SFM_SOURCE, UNKNOWN_LENS, Picture
from vg2gt.inputs.recordings import recording_pictures
from vg2gt.io.colmap import quiet_colmap, require_pycolmap
from vg2gt.io.errors import FormatError, some
from vg2gt.io.files import read_json, whole_folder, write_json
from vg2gt.monitor import Monitor

if TYPE_CHECKING:
    from pycolmap import Reconstruction  # pyright: ignore[reportMissingImports]

log = logging.getLogger(__name__)

FORMAT = 2
"""Version of the folder; increment it when its format changes, or what is masked in images."""
_IMAGE_SIDE = 1600  # maximum longer side of the kept images, in pixels
_LARGE_SIDE = 1200  # features of images from this longer side on are searched without doubling the images first
_FEATURE_SIDE, _FEATURES = 1280, 4096  # longer side of doubled images before doubling, maximum number of features
_MANY_SIDE, _MANY_FEATURES = 1024, 2048  # the same for more than ALL_PAIRS photographs
ALL_PAIRS = 60  # number of photographs up to which all pairs are matched
SEED = 0
_MODEL = "SIMPLE_RADIAL"
_QUALITY = 95  # JPEG quality of the kept images
_FEWEST_POINTS = 20  # minimum number of points of a sound model: a camera that only rotates yields none
_AT_ONCE = 4  # images per batch of feature extraction, to bound memory
_PAIRS_AT_ONCE = 256  # pairs per call of the matcher, which indexes the features of every image in each call
_LARGE_ERROR = 1.1  # pixels, mean reprojection error of photographs that a lens model does not fit
_MASKS = "masks"

PURPOSE = "finding the cameras of photographs"
OTHERWISE = f"or put camera files next to them ({LAYOUTS}), or use a backend that needs no cameras, such as da3_small"
ADVICE = (
    "take more photographs, 20 or more, walking around the scene rather than turning on the spot, each overlapping "
    f"the previous one by two thirds; {OTHERWISE}"
)


def find_cameras(pictures: Sequence[Picture], folder: Path, monitor: Monitor) -> list[Picture]:
    """Returns the pictures for which structure from motion finds a camera: undistorted, with sparse point depths.

    Pictures with the same size and EXIF focal length share one lens. The world frame is COLMAP's, scaled so that the
    median depth of the points over all views is 1. Random seeds are fixed.

    Args:
        pictures: in order; their cameras, if any, are ignored.
        folder: folder of the result; if it already holds the result for the same pictures, nothing is computed.
        monitor: shows and times the stages.

    Returns:
        The placed pictures in the same order and with the same names; the others are named in a warning.

    Raises:
        ImportError: if pycolmap is needed and not installed.
        FileExistsError: if the folder contains other files.
        ValueError: if no model of the scene is found; the message says what to try.
    """
    key = _key(pictures)
    state = _read_state(folder, key)
    if state is None:
        require_pycolmap(PURPOSE, OTHERWISE)
        if folder.exists() and any(folder.iterdir()) and not (folder / SFM_STATE).is_file():
            raise FileExistsError(f"{folder} already exists and contains other files; move it or choose another --out")
        if len(pictures) < 2:
            raise ValueError(f"a single image is not enough to estimate depth or cameras: {ADVICE}")
        state = _solve(pictures, folder, key, monitor)
    if state["left_out"]:
        log.warning(
            "%d of %d images overlap too little with the others; they have no cameras and are left out: %s",
            len(state["left_out"]), len(pictures), ", ".join(state["left_out"]),
        )  # fmt: skip
    if state.get("folded", 0) > len(state["images"]):
        log.warning(
            "sides of the scene look alike: with matches between them, which are removed, %d images were placed, some "
            "on top of each other. If too few are left, photograph in smaller steps, or mark one side", state["folded"],
        )  # fmt: skip
    for part in state.get("other_parts", []):
        log.warning(
            "%d of them form a separate part with no overlap with the %d images used; take photographs in between, or "
            "reconstruct that part separately: %s",
            len(part), len(state["images"]), ", ".join(part),
        )  # fmt: skip
    if undecided := state.get("undecided"):
        log.warning(
            "%d of the %d images used fit at two places: sides of the scene look alike, and nothing around them tells "
            "them apart, so parts of the scene may lie on top of each other. Check the cameras; photograph it again on "
            "a ground with texture, such as a newspaper, or mark one side: %s",
            len(undecided), len(state["images"]), some(undecided),
        )  # fmt: skip
    wide = [picture.name for picture in pictures if picture.size[1] == 2 * picture.size[0]]
    badly = state.get("error", 0) > _LARGE_ERROR or len(state["left_out"]) > len(pictures) / 4
    if badly and 2 * len(wide) > len(pictures):
        log.warning(
            "%d images are twice as wide as high and fit badly as photographs: if they are changed 360 degree "
            "panoramas, give the complete ones, or convert them to cube faces: %s, ...", len(wide), wide[0],
        )  # fmt: skip
    names = state["images"]
    source = f"{SFM_SOURCE}, {len(names)} of {len(pictures)} images"
    paths = {picture.name: picture.path for picture in pictures}
    found = [(names[f"{p.name}.jpg"], p) for p in recording_pictures(COLMAP(str(folder)))]
    return [replace(p, name=name, source=source, path=paths[name], lens=UNKNOWN_LENS) for name, p in found]


def _key(pictures: Sequence[Picture]) -> str:
    """Returns a hash of the pictures' contents, masks, names and order, and of the processing settings."""
    features = feature_settings([max(picture.size) for picture in pictures])
    settings = [FORMAT, _IMAGE_SIDE, *features, SEED, _MODEL, _QUALITY]
    contents = []
    for picture in pictures:
        mask = None if picture.path is None else mask_beside(picture.path)
        hashed = [] if mask is None else [hashlib.sha256(mask.read_bytes()).hexdigest()]
        contents.append([picture.name, picture.size, digest(picture), *hashed])
    return hashlib.sha256(json.dumps([settings, contents]).encode()).hexdigest()


def _read_state(folder: Path, key: str) -> dict[str, Any] | None:
    """Reads the state of a result folder; None if it is missing, damaged, incomplete, or of other pictures."""
    try:
        state = read_json(folder / SFM_STATE)
        same = state["key"] == key and all((folder / "images" / name).is_file() for name in state["images"])
    except (FormatError, OSError, KeyError, TypeError):
        return None
    return state if same and model_folder_of(folder) is not None else None


def _solve(pictures: Sequence[Picture], folder: Path, key: str, monitor: Monitor) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="vg2gt-sfm-") as temporary, quiet_colmap():
        work = Path(temporary)
        with monitor.stage("read photographs", len(pictures)) as advance:
            lenses = _stage(pictures, work, advance)
        names = sorted(name for members in lenses.values() for name in members)
        sides = [max(height, width) for (height, width, _), members in lenses.items() for _ in members]
        settings = feature_settings(sides)
        matches, models = with_right_lenses(
            work / "database.db", lenses, lambda lens, free: _models(work, lens, free, names, settings, monitor)
        )
        if not models:
            raise ValueError(
                f"cannot find the cameras of these {len(pictures)} images: {why_not_placed(matches)}; {ADVICE}"
            )
        check_parallax(models[0])
        folded, remap = models, partial(_map, work, len(names), monitor, is_centre_found(models[0]))
        models, undecided = unfold(work / "database.db", matches, models, remap)
        placed, *others = _parts(models)
        _write(models[0], work)
        titles = {name: picture.name for name, picture in zip(names, pictures, strict=True)}
        state = {
            "key": key,
            "images": {name: title for name, title in titles.items() if name in placed},
            "left_out": [title for name, title in titles.items() if name not in placed],
            "other_parts": [[titles[name] for name in sorted(part)] for part in others if part],
            "lenses": lens_texts(models[0], dict(zip(names, pictures, strict=True))),
            "error": round(models[0].compute_mean_reprojection_error(), 2),
            "undecided": [titles[name] for name in undecided],
            "folded": 0 if models is folded else len(folded[0].images),
        }
        with whole_folder(folder) as staged:
            for part in ("images", "sparse"):
                shutil.move(work / "undistorted" / part, staged / part)
            if (work / _MASKS).exists():
                shutil.move(work / "undistorted-masks" / "images", staged / "masks")
            write_json(staged / SFM_STATE, state)
    return state


def _models(
    work: Path,
    lenses: Lenses,
    centre: bool,
    names: Sequence[str],
    settings: tuple[int, int, int],
    monitor: Monitor,
) -> tuple[Matches, list[Reconstruction]]:
    """Returns the matches and models of images with lenses; arguments as in :func:`find_features`, :func:`_map`."""
    (work / "database.db").unlink(missing_ok=True)
    shutil.rmtree(work / "models", ignore_errors=True)
    find_features(work, lenses, names, settings, monitor)
    match_features(work, names, monitor)
    matches = Matches.read(work / "database.db")
    check_motion(matches)
    return matches, _map(work, len(names), monitor, centre)


def _stage(pictures: Sequence[Picture], work: Path, advance: Any) -> Lenses:
    """Writes the pictures as numbered upright JPEGs; returns their names by (height, width, focal length or 0).

    If any picture has a mask, masks are written for all: to ``masks/`` with COLMAP's names and to ``mask-images/``.
    """
    lenses: Lenses = {}
    masks: dict[str, NDArray[np.uint8]] = {}
    (work / "images").mkdir()
    for number, picture in enumerate(pictures):
        shrink = min(1.0, _IMAGE_SIDE / max(picture.size))
        target = (round(picture.size[0] * shrink), round(picture.size[1] * shrink))
        frames = reduce_to_fit(picture.read(target), (_IMAGE_SIDE, _IMAGE_SIDE))
        pixels = to_bytes(frames.images[0]).permute(1, 2, 0).numpy()
        name = f"{number:06d}.jpg"
        Image.fromarray(pixels).save(work / "images" / name, quality=_QUALITY, subsampling=0)
        height, width = pixels.shape[:2]
        focal = 0.0 if picture.focal is None else round(picture.focal * width / picture.size[1], 1)
        lenses.setdefault((height, width, focal), []).append(name)
        if frames.mask is not None:
            masks[name] = to_bytes(frames.mask[0]).numpy()
        advance()
    for (height, width, _), names in lenses.items():
        for name in names if masks else []:
            mask = Image.fromarray(masks.get(name, np.full((height, width), 255, np.uint8)))
            for file in (work / _MASKS / f"{name}.png", work / "mask-images" / name):
                file.parent.mkdir(exist_ok=True)
                mask.save(file, quality=_QUALITY)
    return lenses


def feature_settings(sides: Sequence[int]) -> tuple[int, int, int]:
    """Chooses the longer side of the images for feature extraction, the maximum number of features, and SIFT's octave.

    Args:
        sides: longer side of every image in pixels.

    Returns:
        Side, number, and first octave: -1 doubles images first, which small ones need to have enough features; 0 takes
        large ones as they are, in a third of the time.
    """
    side, features = (_FEATURE_SIDE, _FEATURES) if len(sides) <= ALL_PAIRS else (_MANY_SIDE, _MANY_FEATURES)
    return (_IMAGE_SIDE, features, 0) if min(sides) >= _LARGE_SIDE else (side, features, -1)


def find_features(
    work: Path,
    lenses: Lenses,
    names: Sequence[str],
    settings: tuple[int, int, int],
    monitor: Monitor,
) -> None:
    """Finds the SIFT features of ``work/images`` and writes them to ``work/database.db``.

    Args:
        work: folder; images in ``masks/`` restrict the features.
        lenses: names of the images by height, width and focal length in pixels (0: unknown).
        names: names of all images.
        settings: see :func:`feature_settings`.
        monitor: shows the stage.
    """
    import pycolmap  # pyright: ignore[reportMissingImports]

    database, images = work / "database.db", work / "images"
    pycolmap.Database.open(database).close()
    for (height, width, focal), members in lenses.items():
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = _MODEL
        if focal > 0:
            reader.camera_params = f"{focal},{width / 2},{height / 2},0"
        pycolmap.import_images(
            database, images, camera_mode=pycolmap.CameraMode.SINGLE, image_names=members, options=reader
        )
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = _threads()
    options.max_image_size, options.sift.max_num_features, options.sift.first_octave = settings
    masked = pycolmap.ImageReaderOptions()
    if (work / _MASKS).exists():
        masked.mask_path = work / _MASKS
    with monitor.stage("find features", len(names)) as advance:
        for start in range(0, len(names), _AT_ONCE):
            some = list(names[start : start + _AT_ONCE])
            pycolmap.extract_features(
                database, images, image_names=some, reader_options=masked, extraction_options=options,
                device=pycolmap.Device.cpu,
            )  # fmt: skip
            for _ in some:
                advance()


def match_features(work: Path, names: Sequence[str], monitor: Monitor) -> None:
    """Matches the features of all pairs of images in ``work/database.db``, of likely pairs only if there are many."""
    import pycolmap  # pyright: ignore[reportMissingImports]

    database = work / "database.db"
    chosen = [(before, later) for later in range(len(names)) for before in range(later)]
    if len(names) > ALL_PAIRS:
        chosen = likely_pairs(descriptors_of(database, names))
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    matching.num_threads = _threads()
    checking = pycolmap.TwoViewGeometryOptions()
    checking.ransac.random_seed = SEED
    pairs = pycolmap.ImportedPairingOptions()
    pairs.match_list_path = work / "pairs.txt"
    parts = [chosen[start : start + _PAIRS_AT_ONCE] for start in range(0, len(chosen), _PAIRS_AT_ONCE)]
    with monitor.stage("match features", len(parts)) as advance:
        for part in parts:
            (work / "pairs.txt").write_text("".join(f"{names[before]} {names[later]}\n" for before, later in part))
            pycolmap.match_image_pairs(
                database,
                matching_options=matching,
                pairing_options=pairs,
                verification_options=checking,
                device=pycolmap.Device.cpu,
            )
            advance()


def _map(work: Path, count: int, monitor: Monitor, centre: bool = False) -> list[Reconstruction]:
    """Returns the models with enough points that COLMAP's incremental mapper finds, the one with most images first.

    The global mapper (``pycolmap.global_mapping``) is not used: on the fox scene it places all 24 photographs with a
    small reprojection error, but a quarter of the path away from their positions, even with calibrated focal lengths.
    If ``centre``, the lenses need not have theirs in the middle of the images.
    """
    import pycolmap  # pyright: ignore[reportMissingImports]

    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1  # fixed order of sums: reproducible cameras
    options.ba_refine_principal_point = centre
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = SEED
    pycolmap.set_random_seed(SEED)
    (work / "models").mkdir(exist_ok=True)
    expected = iter(range(count))
    with monitor.stage("place cameras", count) as advance:
        models = pycolmap.incremental_mapping(
            work / "database.db",
            work / "images",
            work / "models",
            options=options,
            next_image_callback=lambda: advance() if next(expected, None) is not None else None,
        )
    sound = [model for model in models.values() if model.num_points3D() >= _FEWEST_POINTS]
    return sorted(sound, key=lambda model: (model.num_reg_images(), model.num_points3D()), reverse=True)


def _parts(models: Sequence[Reconstruction]) -> list[set[str]]:
    """Returns the names of the images that have a camera in each model and in none before it."""
    parts: list[set[str]] = []
    for model in models:
        placed = {image.name for image in model.images.values() if image.has_pose}
        parts.append(placed.difference(*parts))
    return parts


def _write(model: Reconstruction, work: Path) -> None:
    """Scales the points' median depth to 1 and writes undistorted images and their model to ``work/undistorted``."""
    import pycolmap  # pyright: ignore[reportMissingImports]

    depths = []
    for image in model.images.values():
        if image.has_pose:
            pose = image.cam_from_world().matrix()
            ids = [point.point3D_id for point in image.points2D if point.has_point3D()]
            depths += [float(pose[2, :3] @ model.points3D[number].xyz + pose[2, 3]) for number in ids]
    model.transform(pycolmap.Sim3d(1 / float(np.median(depths)), pycolmap.Rotation3d(), np.zeros(3)))
    (work / "model").mkdir()
    model.write(work / "model")
    for source, target in (("images", "undistorted"), ("mask-images", "undistorted-masks")):
        if (work / source).exists():
            pycolmap.undistort_images(
                work / target, work / "model", work / source, jpeg_quality=_QUALITY, num_threads=_threads()
            )


def _threads() -> int:
    """Returns the number of threads, at most one per image of a feature extraction batch; matching uses the same."""
    return min(_AT_ONCE, torch.get_num_threads())
