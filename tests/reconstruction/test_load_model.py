import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

import vg2gt
from vg2gt.config import compose_groups
from vg2gt.memory import OutOfMemory
from vg2gt.method import FineModule
from vg2gt.reconstruction import refined
from vg2gt.reconstruction.pipeline import reconstruct_with
from vg2gt.reconstruction.policy import refinement_for
from vg2gt.refinement import RefineOptions
from vg2gt.runs.checkpoints import read_checkpoint, write_checkpoint, write_slim
from vg2gt.runs.load import SHIPPED, load_model, made_of, resolve_parts


def test_a_run_is_rebuilt_with_its_weights(run_folder: Path, ready) -> None:
    loaded = load_model(run_folder, device="cpu")
    marked = loaded.model.get_parameter("gaussians.out.bias") - ready.model.get_parameter("gaussians.out.bias")
    assert torch.allclose(marked, torch.full_like(marked, 0.25))
    assert str(loaded.weights).endswith("step-7.ckpt (step 7)")
    assert not loaded.model.training


def test_options_change_parts(run_folder: Path) -> None:
    overrides = ["backend.depth_noise=0.5", "+backend.taps=4", "model.fine.max_voxels=50", "renderer.near=0.5"]
    for backend in ("oracle", None):  # named again, or the run's own
        loaded = load_model(run_folder, backend, overrides, device="cpu")
        fine = loaded.model.get_submodule("fine")
        assert isinstance(fine, FineModule)
        assert (loaded.model.backend.depth_noise, fine.cap.limit) == (0.5, 50)
        assert loaded.renderer.near == 0.5


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["backend=oracle", "backend.noise=1"], r"Could not override 'backend\.noise'"),
        (["backend.noise=1"], r"option 'backend\.noise=1': .*not in struct; backend has .*path"),
        (["backend=oracle", "backend.taps"], "expected key=value"),
        (["backend=oracle", "backend.depth_noise=-1"], "noise must not be negative"),
    ],
)
def test_what_is_unknown_is_named(overrides: list[str], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        load_model(overrides=overrides)


def test_a_slim_checkpoint_is_the_same_model(run_folder: Path, tmp_path: Path) -> None:
    """Weights without the optimiser, with their configuration: no run folder is needed."""
    whole_file = run_folder / "checkpoints" / "step-7.ckpt"
    slim = write_slim(whole_file, tmp_path / "weights.safetensors")
    whole, loaded = load_model(run_folder, device="cpu"), load_model(slim, device="cpu")
    state = loaded.model.trained_state()
    assert all(torch.equal(state[name], value) for name, value in whole.model.trained_state().items())
    assert loaded.weights.step == whole.weights.step
    with pytest.raises(ValueError, match="trained on backbone"):
        load_model(slim, "da3_tiny", device="cpu")
    slim.write_bytes(slim.read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"weights\.safetensors is damaged"):
        load_model(slim, device="cpu")
    with pytest.raises(ValueError, match="must end with"):
        write_slim(whole_file, tmp_path / "weights.ckpt")


def test_what_ships_needs_no_name() -> None:
    """Nothing named: the plane sweep and the head that was trained on it, both from the package."""
    loaded = load_model(device="cpu")
    assert (loaded.model.backend.name, loaded.weights.path) == ("sweep", SHIPPED)
    assert load_model(backend="sweep", device="cpu").weights.path == SHIPPED


def test_views_check_the_depth_of_learned_backbones() -> None:
    assert load_model(backend="da3_tiny", device="cpu").model.visibility is not None
    assert load_model(backend="da3_tiny", overrides=["model=tiny"], device="cpu").model.visibility is None
    assert load_model(backend="oracle", device="cpu").model.visibility is None
    with pytest.raises(ValueError, match="this model has none, use model=tiny_ungated"):
        load_model(backend="oracle", overrides=["+model.visibility.moment=3"], device="cpu")


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("taps=[0,1,2,3]", r"backend\.taps=\[1, 3, 5, 7\], but this run uses \[0, 1, 2, 3\]"),
        ("reference_view=saddle_balanced", "backend.reference_view=first, but this run uses saddle_balanced"),
    ],
)
def test_the_same_weights_with_other_tokens_are_refused(option: str, said: str, tmp_path: Path) -> None:
    """Neither changes a shape or the weights' hash."""
    built = load_model(backend="da3_tiny", device="cpu")
    checkpoint = {
        "state_dict": {f"model.{name}": value for name, value in built.model.trained_state().items()},
        "backend": dict(built.model.backend.identity()),
        "global_step": 1,
        "config": made_of(compose_groups("backend=da3_tiny", "model=tiny", "renderer=solid")),
    }
    write_checkpoint(checkpoint, tmp_path / "step-1.ckpt")
    assert load_model(tmp_path / "step-1.ckpt", "da3_tiny", ["backend.head_chunk=2"], device="cpu").weights.step == 1
    for backend in ("da3_tiny", None):  # named again, or the run's own
        with pytest.raises(ValueError, match=said):
            load_model(tmp_path / "step-1.ckpt", backend, [f"+backend.{option}"], device="cpu")
    with pytest.raises(ValueError, match=said):  # as the evaluation does
        resolve_parts(OmegaConf.from_dotlist([f"backend.{option}"]), tmp_path / "step-1.ckpt")


def test_weights_of_a_diverged_training_are_refused(run_folder: Path, tmp_path: Path) -> None:
    copied = shutil.copytree(run_folder, tmp_path / "run")
    path = copied / "checkpoints" / "step-7.ckpt"
    content = read_checkpoint(path)
    content["state_dict"]["model.gaussians.out.bias"][3] = torch.nan
    write_checkpoint(content, path)
    with pytest.raises(ValueError, match=r"step-7\.ckpt has non-finite weights \(model\.gaussians\.out\.bias"):
        load_model(copied, device="cpu")


def test_python_interface(run_folder: Path, recording: Path, tmp_path: Path) -> None:
    model = vg2gt.load(run_folder, overrides=["+renderer.alpha_max=0.9"], device="cpu")
    scene = model.reconstruct(recording, size=56, max_images=2)
    assert scene.renderer.alpha_max == 0.9
    assert isinstance(scene, vg2gt.Scene)
    assert (scene.images.shape, scene.names) == ((2, 3, 42, 56), ("008", "011"))
    again = reconstruct_with(load_model(run_folder, device="cpu").model, recording, size=56, max_images=2)
    assert torch.equal(again.gaussians.means, scene.gaussians.means)
    out = scene.save(tmp_path / "out", ["scene.ply"])
    with pytest.raises(FileExistsError, match="already exists"):
        scene.save(out, ["scene.ply"])
    before = (out / "scene.ply").stat().st_mtime_ns
    scene.save(out, ["scene.ply", "scene.html"], overwrite=True)
    assert (out / "scene.ply").stat().st_mtime_ns > before
    assert "<title>out</title>" in (out / "scene.html").read_text()


def test_errors_are_stated_and_the_scene_is_refined_by_its_kind(recording: Path, monkeypatch) -> None:
    """A loaded model brings its calibration; photographs are refined unless asked not to, recordings on demand."""
    asked: list[RefineOptions] = []
    monkeypatch.setattr(refined, "refine_scene", lambda scene, how, *_: asked.append(how) or scene)
    model = vg2gt.load(device="cpu")
    scene = model.reconstruct(recording, size=56, max_images=2)
    assert (scene.error is not None, asked) == (True, [])
    photographs = replace(scene, cameras_from="COLMAP here")
    for each, refine, quality in (
        (photographs, None, "normal"),
        (photographs, False, "normal"),
        (photographs, 0, "normal"),
        (photographs, True, "draft"),
        (photographs, 7, "normal"),
        (scene, None, "high"),
        (scene, True, "normal"),
        (scene, RefineOptions(steps=3), "normal"),
    ):
        refined.refined_by_policy(each, refine, quality)
    normal, draft = refinement_for(photographs), refinement_for(photographs, "draft")
    seven = replace(normal, steps=7, full=None)
    assert asked == [normal, draft, seven, refinement_for(scene), RefineOptions(steps=3)]
    asked.clear()
    model.reconstruct(recording, size=56, max_images=2, overrides=["refine.steps=5"])
    photographs.refine(steps=50)
    scene.refine(steps=50)
    assert asked == [replace(refinement_for(scene), steps=5), replace(normal, steps=50), RefineOptions(steps=50)]


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"quality": "best"}, "choose one of draft, normal, high"),
        ({"refine": -3}, "refine.steps must be at least 1"),
        ({"overrides": ["refine.full.crops=3"]}, "crops"),
    ],
)
def test_wrong_options_of_a_refinement_end_before_any_work(
    wrong: dict, said: str, recording: Path, monkeypatch
) -> None:
    monkeypatch.setattr("vg2gt.reconstruction.pipeline.reconstruct_with", lambda *_, **__: pytest.fail("reconstructed"))
    with pytest.raises(ValueError, match=said):
        vg2gt.load(device="cpu").reconstruct(recording, **wrong)


def test_full_memory_of_a_refinement_names_what_takes_less(scene: vg2gt.Scene, monkeypatch) -> None:
    monkeypatch.setattr(refined, "refine_scene", lambda *_: torch.empty(1 << 60))
    with pytest.raises(OutOfMemory, match=r"4 images of 84x112.*refine\.full\.size"):
        refined.refined_by_policy(scene, True)


@pytest.mark.parametrize("error", [torch.OutOfMemoryError("CUDA out of memory"), MemoryError("no more")])
def test_full_memory_names_the_knobs(error: Exception, ready, recording: Path, monkeypatch) -> None:
    def fail(*args, **kwargs):
        raise error

    monkeypatch.setattr(ready.model.fine, "pool", fail)
    with pytest.raises(OutOfMemory, match=r"4 images of 84x112.*--max-images.*--size.*head_chunk"):
        reconstruct_with(ready.model, recording)
