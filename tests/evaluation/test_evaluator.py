import math
from dataclasses import asdict, replace

import pytest
import torch

from tests.evaluation.conftest import without_cost
from vg2gt.evaluation.evaluator import MODES, PROTOCOLS, EvaluationOptions, PointOptions, SceneEvaluator, SceneResult
from vg2gt.evaluation.in_training import evaluate_scene
from vg2gt.evaluation.pictures import PANELS, scene_picture
from vg2gt.evaluation.protocols import ground_truth_target_cameras, joint_target_cameras
from vg2gt.evaluation.scene_metrics import align_geometry, image_metrics, point_cloud_metrics
from vg2gt.geometry.alignment import Similarity
from vg2gt.geometry.cameras import relative_to_first, scale_translations
from vg2gt.geometry.normals import normals_from_depth
from vg2gt.metrics import cv, depth_metrics, near_depth_edges, normal_metrics, psnr, ssim
from vg2gt.refinement import RefineOptions
from vg2gt.types import Batch


def test_scores_are_the_metrics_of_the_renders(result: SceneResult, batch: Batch) -> None:
    truth = batch.target
    render = result.renders["gt_pose"]
    expected = {f"rendered/gt_pose/solid/{k}": v for k, v in depth_metrics(render.depth[0], truth.depth[0]).items()}
    expected["rendered/gt_pose/solid/psnr"] = float(psnr(render.color[0], truth.images[0]).mean())
    expected["rendered/gt_pose/solid/ssim"] = float(ssim(render.color[0], truth.images[0]).mean())
    normals, valid = normals_from_depth(truth.depth[0], truth.cameras.intrinsics[0])
    found = normal_metrics(render.normal[0], normals, valid & (render.depth[0] > 0))
    expected |= {f"rendered/gt_pose/solid/normal_{k}": v for k, v in found.items()}
    prediction = result.prediction
    for when, geometry in (("before", prediction.initial), ("after", prediction.geometry)):
        scores = depth_metrics(geometry.depth[0], batch.context.depth[0])
        expected |= {f"decoded/{when}/{k}": v for k, v in scores.items()}
    expected["scene/cv"] = cv(prediction.gaussians.means)
    expected["scene/gaussians"] = len(prediction.gaussians)
    assert {name: result.metrics[name] for name in expected} == expected


def test_every_protocol_and_mode_has_every_figure(result: SceneResult) -> None:
    scores = result.metrics
    for protocol in PROTOCOLS:
        for mode in MODES:
            for name in ("psnr", "ssim", "abs_rel", "mae", "rmse", "coverage", "delta_1.05_holes", "normal_acc_30"):
                assert scores[f"rendered/{protocol}/{mode}/{name}"] is not None
    assert scores["cameras/auc_30"] is not None
    for cloud in ("rendered", "decoded"):
        assert 0 < (scores[f"points/{cloud}/f_score"] or 0) <= 1
    assert (scores["scene/reconstruct_seconds"] or 0) > (scores["scene/head_seconds"] or 0) > 0
    assert not any(name.endswith("lpips") for name in scores)


def test_rasterized_depth_can_be_the_expected_one(evaluator: SceneEvaluator, result: SceneResult, batch: Batch) -> None:
    """Eq. A1 instead of the median, in the rasterised rows alone."""
    renderer = replace(evaluator.renderer, mode="rasterized", depth="expected")
    found = replace(evaluator, renderer=renderer)(batch)
    solid, rasterized = (f"rendered/gt_pose/{mode}/abs_rel" for mode in MODES)
    assert found.metrics[solid] == result.metrics[solid]
    assert found.metrics[rasterized] != result.metrics[rasterized]
    render = renderer(found.prediction.gaussians, ground_truth_target_cameras(batch, found.prediction))
    assert found.metrics[rasterized] == depth_metrics(render.depth[0], batch.target.depth[0])["abs_rel"]


def test_refined_scenes_have_figures_of_their_own(evaluator: SceneEvaluator, result: SceneResult, batch: Batch) -> None:
    found = replace(evaluator, refinement=RefineOptions(steps=12, check_every=6))(batch).metrics
    again = {name: value for name, value in found.items() if not name.startswith("refined/")}
    assert without_cost(again) == without_cost(result.metrics)
    path = "rendered/gt_pose/solid/psnr"
    assert (found[f"refined/{path}"] or 0) > (found[path] or 0) + 0.5
    assert (found["refined/scene/refine_seconds"] or 0) > 0
    assert found["refined/cameras/auc_3"] is not None
    assert not any(name.startswith("refined/decoded") for name in found)


def test_without_true_depth_what_needs_it_is_none_and_not_zero(evaluator, batch: Batch, monkeypatch) -> None:
    encode = evaluator.model.backend.encode

    def told(images, hints):
        """The backbone is told the depth all the same: the oracle has nothing else."""
        return encode(images, replace(hints, depth=batch.depth[:, : images.shape[1]]))

    monkeypatch.setattr(evaluator.model.backend, "encode", told)
    scores = evaluator(replace(batch, depth=torch.zeros_like(batch.depth))).metrics
    for name in ("abs_rel", "coverage", "delta_1.05_holes", "normal_mean"):
        assert scores[f"rendered/gt_pose/solid/{name}"] is None
    assert scores["decoded/after/abs_rel"] is None
    assert scores["rendered/gt_pose/solid/psnr"] is not None
    assert "points/decoded/chamfer" not in scores


def test_without_targets_or_pairs_of_views(evaluator: SceneEvaluator, batch: Batch) -> None:
    inputs_only = evaluator(batch.context)
    assert set(inputs_only.renders) == {"context"}
    one_view = replace(batch, num_context=1)
    assert "cameras/auc_5" not in evaluator(one_view).metrics


def test_true_depth_out_of_range_is_unknown_to_every_figure(module_and_batch, result: SceneResult, batch) -> None:
    module, _ = module_and_batch
    middle = float(batch.depth[batch.depth > 0].median())
    near = replace(batch, depth=torch.where(batch.depth <= middle, batch.depth, 0.0))
    options = EvaluationOptions(alignment="scene", depth_range=(None, middle), neighbors=3)
    limited = SceneEvaluator(module.model, module.renderer, options)(batch)
    target, render, scores = near.target, limited.renders["gt_pose"], limited.metrics
    expected = depth_metrics(render.depth[0], target.depth[0], "scene")
    assert scores["rendered/gt_pose/solid/abs_rel"] == expected["abs_rel"]
    assert scores["scene/cv"] != result.metrics["scene/cv"]  # of 3 neighbours
    normals, valid = normals_from_depth(target.depth[0], target.cameras.intrinsics[0])
    expected = normal_metrics(render.normal[0], normals, valid & (render.depth[0] > 0))
    assert scores["rendered/gt_pose/solid/normal_mean"] == expected["mean"]
    geometry = limited.prediction.geometry
    similarity = align_geometry(geometry, near.context)
    points = point_cloud_metrics(geometry.depth, geometry.cameras, near.context, similarity, **asdict(PointOptions()))
    assert scores["points/decoded/f_score"] == points["f_score"]


def test_masked_pixels_count_as_correct(result: SceneResult, batch: Batch) -> None:
    render, truth = result.renders["gt_pose"], batch.target
    mask = torch.ones_like(truth.depth)
    mask[..., :56] = 0
    found = image_metrics(render, replace(truth, mask=mask))
    right = psnr(render.color[0, :, :, :, 56:], truth.images[0, :, :, :, 56:])
    assert found["psnr"] == pytest.approx(float(right.mean()) + 10 * math.log10(2), abs=1e-3)
    assert found["ssim"] > image_metrics(render, truth)["ssim"]
    none = torch.zeros_like(mask)
    assert image_metrics(render, replace(truth, mask=none)) == {}
    none[:, 0] = mask[:, 0]  # the others do not count
    first = replace(truth, images=truth.images[:, :1], mask=mask[:, :1])
    expected = image_metrics(replace(render, color=render.color[:, :1]), first)
    assert image_metrics(render, replace(truth, mask=none)) == pytest.approx(expected)


def test_points_of_unknown_pixels_are_not_wrong(batch: Batch) -> None:
    context = batch.context
    holes = torch.zeros_like(context.depth, dtype=torch.bool)
    holes[:, :, :, ::2] = True
    holes[:, 0] = True  # a view without any depth
    truth = replace(context, depth=torch.where(holes, 0.0, context.depth))
    perfect = Similarity(torch.ones(1), torch.eye(3)[None], torch.zeros(1, 3))
    scores = point_cloud_metrics(context.depth, context.cameras, truth, perfect, threshold=1e-4)
    assert scores["precision"] == scores["recall"] == 1
    assert scores["accuracy"] == 0


def test_wrong_options_are_named() -> None:
    bounds = [(5, 1), (None, 0), (-1, None), (2, 2)]
    cases = [({"depth_range": each}, "depth_range=.* leaves no depth") for each in bounds]
    cases += [({"alignment": "affine"}, "alignment is 'affine'")]
    for options, told in cases:
        with pytest.raises(ValueError, match=told):
            EvaluationOptions(**options)


def test_given_cameras_need_no_joint_pass(module_and_batch, batch: Batch, monkeypatch: pytest.MonkeyPatch) -> None:
    """A backend whose cameras are the data's is not asked for those of held-out views."""
    module, _ = module_and_batch
    inputs = replace(batch, num_context=3)
    model = module.model
    with torch.no_grad():
        prediction = model(inputs.context.images, inputs.context.hints)
    monkeypatch.setattr(model.backend, "predicts_cameras", False)
    monkeypatch.setattr(model.backend, "encode", None)
    found = joint_target_cameras(model, inputs, prediction)
    data = relative_to_first(batch.cameras).world_to_camera[:, 3:]
    torch.testing.assert_close(found.world_to_camera[..., :3, :3], data[..., :3, :3])
    torch.testing.assert_close(found.world_to_camera[..., :3, 3], data[..., :3, 3] * prediction.unit[:, None, None])


@pytest.mark.parametrize("views", [1, 3])
def test_the_joint_pass_may_have_another_unit(module_and_batch, batch: Batch, views: int, monkeypatch) -> None:
    """As backbones without metric scale have: three times larger as soon as held-out views are seen too."""
    module, _ = module_and_batch
    inputs = replace(batch, num_context=views)
    backend = module.model.backend
    decode, predict_cameras, three = backend.decode, backend.predict_cameras, torch.full((1,), 3.0)

    def rescaled(tokens):
        geometry = decode(tokens)
        return replace(geometry, depth=geometry.depth * 3, cameras=scale_translations(geometry.cameras, three))

    with torch.no_grad():
        prediction = module.model(inputs.context.images, inputs.context.hints)
    plain = joint_target_cameras(module.model, inputs, prediction)
    monkeypatch.setattr(backend, "decode", rescaled)
    monkeypatch.setattr(backend, "predict_cameras", lambda *args: scale_translations(predict_cameras(*args), three))
    found = joint_target_cameras(module.model, inputs, prediction)
    torch.testing.assert_close(found.world_to_camera, plain.world_to_camera, rtol=1e-4, atol=1e-5)


def test_the_figures_of_training_runs(module_and_batch, batch: Batch) -> None:
    """What ``train.py`` reports, spelt out once more."""
    module, _ = module_and_batch
    found = evaluate_scene(module.model, module.renderer, batch, rasterized=True)
    plain = evaluate_scene(module.model, module.renderer, batch)
    assert found.keys() - plain.keys() == {"abs_rel_rasterized"}
    with torch.no_grad():
        prediction = module.model(batch.context.images, batch.context.hints)
        cameras = ground_truth_target_cameras(batch, prediction)
        solid = module.renderer(prediction.gaussians, cameras, mode="solid")
        flat = module.renderer(prediction.gaussians, cameras, mode="rasterized")
    depth = depth_metrics(solid.depth[0], batch.target.depth[0], "scene")
    for name in ("abs_rel", "delta_1.05", "coverage"):
        assert found[name] == depth[name]
    assert found["psnr"] == float(psnr(solid.color[0], batch.target.images[0]).mean())
    assert found["abs_rel_rasterized"] == depth_metrics(flat.depth[0], batch.target.depth[0], "scene")["abs_rel"]
    decoded = depth_metrics(prediction.geometry.depth[0], batch.context.depth[0], "scene")
    assert found["decoded_abs_rel"] == decoded["abs_rel"]
    region = near_depth_edges(batch.target.depth)[0]
    edges = depth_metrics(solid.depth[0], batch.target.depth[0], "scene", region=region)
    assert found["edge_abs_rel"] == edges["abs_rel"] > found["abs_rel"]
    assert found["edge_psnr"] < found["psnr"]
    with pytest.raises(ValueError, match="held-out views"):
        evaluate_scene(module.model, module.renderer, batch.context)


def test_a_grid_of_all_panels(result: SceneResult, batch: Batch) -> None:
    render = result.renders["gt_pose"]
    columns, gap, (height, width) = len(PANELS.split("|")), 4, batch.images.shape[-2:]
    picture = scene_picture(batch, render, batch.target)
    assert picture.shape == (3, 3 * (height + gap) - gap, columns * (width + gap) - gap)
    assert picture.min() >= 0
    assert picture.max() <= 1
    torch.testing.assert_close(picture[:, :height, -width:], batch.target.images[0, 0])
