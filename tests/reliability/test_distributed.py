"""Two processes train like one with twice the scenes, and end together; a batch of two scenes is the mean of two."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tests.losses.conftest import Sample, make_sample
from tests.reliability import two_ranks
from tests.reliability.crash_harness import assert_equal
from tests.reliability.degenerate import SCENES
from tests.reliability.steps import TINY, first_batches, tiny_run
from tests.training_helpers import SMALL
from vg2gt.losses import EnhancementLoss, GaussianLoss, ScaleAlignment, VG2GTLoss
from vg2gt.runs.checkpoints import newest, read_checkpoint
from vg2gt.training.loop import Run
from vg2gt.types import Batch

# --------------------------------------------------------------------------------------------- scenes count alike

OBJECTIVES = {
    "default": VG2GTLoss(),
    "decoded normals, trusted alike": VG2GTLoss(gaussian=GaussianLoss(confidence_weighted=False)),
    "rendered normals": VG2GTLoss(gaussian=GaussianLoss(normal_target="render")),
    "true normals": VG2GTLoss(gaussian=GaussianLoss(normal_target="gt")),
    "hinge on the error": VG2GTLoss(enhance=EnhancementLoss(margin=0.01, on="reg")),
    "hinge as printed": VG2GTLoss(enhance=EnhancementLoss(form="paper_literal")),
    "scale of the renders": VG2GTLoss(align=ScaleAlignment(source="rendered")),
}


def two_scenes() -> Sample:
    """A good scene and a worse one of another size: batch-wide quantiles, scales or hinges would mix them."""
    sample = make_sample(scenes=2, size=(24, 48))
    noise = torch.Generator().manual_seed(3)
    shape = sample.prediction.geometry.depth.shape
    worse = torch.tensor([0.02, 0.5], dtype=torch.float64)[:, None, None, None]
    depth = sample.prediction.geometry.depth * (1 + worse * torch.randn(shape, generator=noise, dtype=torch.float64))
    start = sample.prediction.initial.depth * (1 + 0.1 * torch.randn(shape, generator=noise, dtype=torch.float64))
    truth = sample.batch.depth * torch.tensor([1.0, 7.0], dtype=torch.float64)[:, None, None, None]
    return sample.with_depth(depth).with_initial(start).with_truth(truth)


def scene_of(sample: Sample, index: int) -> Sample:
    def only(tensor: Tensor) -> Tensor:
        return tensor[index : index + 1]

    whole = sample.prediction
    changes = {"initial": whole.initial.map(only), "geometry": whole.geometry.map(only), "unit": only(whole.unit)}
    shown = {"rendered": sample.rendered.map(only), "cameras": sample.cameras.scene(index)}
    return replace(sample, batch=sample.batch.single(index), prediction=replace(whole, **changes), **shown)


def leaves(sample: Sample) -> tuple[Sample, list[Tensor]]:
    """The same sample, and the tensors of the prediction to which gradients flow."""
    geometry = sample.prediction.geometry
    depth, conf = (t.clone().requires_grad_() for t in (geometry.depth, geometry.depth_conf))
    images = {name: image for name, image in vars(sample.rendered).items() if image is not None}
    render = {name: image.clone().requires_grad_() for name, image in images.items()}
    return sample.with_depth(depth, conf).with_render(**render), [depth, conf, *render.values()]


def value_and_gradients(loss: VG2GTLoss, sample: Sample) -> tuple[Tensor, dict[str, Tensor], list[Tensor]]:
    sample, inputs = leaves(sample)
    report = loss(*sample.inputs)
    gradients = torch.autograd.grad(report.total, inputs, allow_unused=True, materialize_grads=True)
    return report.total.detach(), report.terms, list(gradients)


@pytest.mark.parametrize("name", OBJECTIVES)
def test_the_loss_of_two_scenes_is_the_mean_of_theirs(name: str) -> None:
    loss, sample = OBJECTIVES[name], two_scenes()
    total, terms, gradients = value_and_gradients(loss, sample)
    alone = [value_and_gradients(loss, scene_of(sample, index)) for index in range(2)]
    torch.testing.assert_close(total, (alone[0][0] + alone[1][0]) / 2, rtol=1e-12, atol=0)
    assert alone[0][0] != alone[1][0]
    for term, value in terms.items():
        torch.testing.assert_close(value, (alone[0][1][term] + alone[1][1][term]) / 2, rtol=1e-12, atol=1e-14)
    for together, first, second in zip(gradients, alone[0][2], alone[1][2], strict=True):
        torch.testing.assert_close(together, torch.cat((first, second)) / 2, rtol=1e-9, atol=1e-14)


def step(run: Run, batch: Batch) -> tuple[Tensor, Tensor]:
    """Loss and gradient of one training step."""
    module = run.module
    module.train()
    module.model.backend.eval()
    module.zero_grad()
    module.generator.manual_seed(5)
    loss = module.training_step(batch, 0)
    loss.backward()
    return loss.detach(), torch.cat([p.grad.flatten() for p in module.model.trained_parameters() if p.grad is not None])


def test_the_step_of_two_scenes_is_the_mean_of_theirs(tmp_path: Path, cache: Path) -> None:
    """From images to gradients, through backbone, voxels, Gaussians and renders."""
    run = tiny_run(tmp_path, cache, "data.max_images=4")
    batch = first_batches(run, 1)[0]
    generator, apart, deviations = torch.Generator().manual_seed(0), [], []
    for _ in range(5):
        with torch.no_grad():  # away from the zero convolutions
            for parameter in run.module.model.trained_parameters():
                parameter += 0.02 * torch.randn(parameter.shape, generator=generator)
        loss, gradient = step(run, batch)
        first, second = (step(run, batch.single(index)) for index in range(2))
        assert first[0] != second[0]
        apart.append(float(loss - (first[0] + second[0]) / 2))
        mean = (first[1] + second[1]) / 2
        deviations.append((gradient - mean).norm() / mean.norm())
    # Rounding: a pixel's depth may pass from one Gaussian to another (1e-5 of the loss in two of five draws on one
    # processor), and a rendered pixel that equals its image's colour has either sign of L1's gradient (1e-4 of the
    # gradient's norm in two of 23 draws). Mixed scenes would spoil every draw.
    assert min(map(abs, apart)) < 1e-6, apart
    assert max(map(abs, apart)) < 1e-4, apart
    assert min(deviations) < 5e-6, deviations


# ----------------------------------------------------------------------------- a failed process ends the others


MODELS = ["model=tiny", "model=pixel_aligned", "model=voxel_merged"]
VARIANTS = ["model.coarse=null", "model.gaussians.splits=1", "loss.gaussian.weight=0"]


@pytest.mark.parametrize("override", MODELS + VARIANTS)
def test_every_parameter_has_a_gradient_whatever_the_scene(tmp_path: Path, cache: Path, override: str) -> None:
    """DDP waits for the gradient of every parameter of every rank."""
    run = tiny_run(tmp_path, cache, override)
    batch = first_batches(run, 1)[0]
    size = len(two_ranks.weights(run))
    empty = two_ranks.BLIND if override in MODELS else []
    for scene in ("unchanged", *empty):
        assert len(step(run, SCENES[scene](batch))[1]) == size, scene


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory, cache: Path) -> tuple[Path, list[subprocess.CompletedProcess]]:
    """All short scenarios, the one that fails last."""
    folder = tmp_path_factory.mktemp("two")
    names = ("sgd", "empty_rank", "faulty_rank", "three_scenes", "one_scene", *two_ranks.PROVEN, "broken_loader")
    return folder, two_ranks.run_on_ranks(folder, cache, *names)


def results(two: tuple[Path, list[subprocess.CompletedProcess]], name: str, ranks: int = 2) -> list[dict]:
    folder, ended = two
    files = [folder / f"{name}-{rank}.pt" for rank in range(ranks)]
    assert all(path.is_file() for path in files), [rank.stderr[-3000:] for rank in ended]
    return [torch.load(path, weights_only=True) for path in files]


def test_two_processes_train_like_one_with_twice_the_scenes(two, tmp_path: Path, cache: Path) -> None:
    run = tiny_run(tmp_path, cache, *two_ranks.step_overrides(two_ranks.SGD, 4, scenes=2))
    before = two_ranks.weights(run)
    one = two_ranks.trained(run)
    assert (one["weights"] - before).abs().max() > 1e-3
    ranks = results(two, "sgd")
    assert torch.equal(ranks[0]["weights"], ranks[1]["weights"])
    assert ranks[0]["losses"] == ranks[1]["losses"] == pytest.approx(one["losses"], rel=0, abs=2e-6)
    assert (one["weights"] - ranks[0]["weights"]).abs().max() < 2e-6
    assert len(before) < sum(parameter.numel() for parameter in run.module.parameters())
    assert [rank["averaged"] for rank in ranks] == [len(before)] * 2  # the trained part alone


@pytest.mark.parametrize("name", two_ranks.PROVEN)
def test_every_step_of_two_processes_is_that_of_one_with_the_scenes_of_both(two, tmp_path, cache, name) -> None:
    """At equal weights, so that rounding does not add up; views vary, and one rank's scene has little or nothing."""
    ranks = results(two, name)
    assert len(set(ranks[0]["views"])) > 1
    one = two_ranks.step_by_step(tmp_path, cache, two_ranks.PROVEN[name], [0, 1], ranks[0]["weights"])
    apart, deviations = [], []
    for step in range(len(two_ranks.ON_RANK_1)):
        first, second = (rank["gradients"][step] for rank in ranks)
        assert torch.equal(first, second)
        assert torch.equal(ranks[0]["weights"][step], ranks[1]["weights"][step])
        assert ranks[0]["losses"][step] == ranks[1]["losses"][step]
        deviations.append(float((first - one["gradients"][step]).norm() / first.norm()))
        apart.append(abs(ranks[0]["losses"][step] - one["losses"][step]))
    print(name, ranks[0]["views"], apart, deviations)
    # rounding, as in the test of one step above: now and then it moves a pixel from one Gaussian to another
    assert min(apart) < 1e-6, apart
    assert max(apart) < 1e-4, apart
    assert min(deviations) < 5e-6, deviations
    assert max(deviations) < 1e-2, deviations


def test_an_empty_rank_holds_nobody_up(two) -> None:
    first, second = results(two, "empty_rank")
    assert first["steps"] == second["steps"] == len(two_ranks.EMPTY)
    assert first["dropped"] == second["dropped"]
    assert torch.equal(first["weights"], second["weights"])
    assert bool(first["weights"].isfinite().all())


def test_a_fault_on_one_rank_drops_the_step_on_both(two) -> None:
    first, second = results(two, "faulty_rank")
    assert first["dropped"] == second["dropped"] == [False, True, False]
    assert torch.equal(first["weights"], second["weights"])
    (fault,) = first["faults"]
    assert fault.startswith("step 1, rank 1, ")
    assert fault.endswith(": images, depth or cameras of the batch")


def test_evaluation_on_two_ranks_is_that_of_one(two, tmp_path: Path, cache: Path) -> None:
    """Three scenes, one of them without the metrics of depth: every bit is the same."""
    one = two_ranks.three_scenes(tmp_path, cache)
    assert {"psnr", "abs_rel"} <= one.keys()
    assert results(two, "three_scenes") == [one, one]


def test_fewer_scenes_than_ranks_can_be_evaluated_while_training(two) -> None:
    first, second = results(two, "one_scene")
    assert first == second
    assert first["eval/psnr"] > 5


def test_an_error_of_one_rank_ends_both(two) -> None:
    folder, ended = two
    assert not list(folder.glob("broken_loader-*.pt"))
    assert all(rank.returncode != 0 for rank in ended)
    assert "this batch cannot be read" in ended[1].stderr


# ------------------------------------------------------------------------------------------------------------- slow


@pytest.mark.slow
def test_tasks_of_a_slurm_job_find_each_other(tmp_path: Path, cache: Path) -> None:
    """The environment that srun gives two tasks of one node."""
    job = {"SLURM_JOB_ID": "4242", "SLURM_JOB_NAME": "train", "SLURM_NODELIST": "127.0.0.1", "SLURM_NODEID": "0"}
    job |= {"SLURM_NTASKS": "2", "SLURM_NTASKS_PER_NODE": "2", "SLURM_JOB_NUM_NODES": "1"}
    job |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(two_ranks.free_port())}
    small = [*SMALL, *TINY[:7], f"data.cache_dir={cache}", "trainer=slurm", "name=job"]
    command = [sys.executable, "-m", "vg2gt.cli.train", *small]
    numbers = [{"SLURM_PROCID": task, "SLURM_LOCALID": task} for task in "01"]
    tasks = [subprocess.Popen(command, cwd=tmp_path, env={**os.environ, **job, **number}) for number in numbers]
    try:
        assert [task.wait(1200) for task in tasks] == [0, 0]
    finally:
        for task in tasks:
            task.kill()
    assert (tmp_path / "outputs" / "job" / "metrics.json").is_file()


@pytest.mark.slow
def test_two_processes_of_which_one_is_killed_go_on(tmp_path: Path, cache: Path) -> None:
    """Both end, and the same command continues to the weights and moments of the uninterrupted run, bit for bit."""
    ended = two_ranks.run_on_ranks(tmp_path, cache, "whole")
    results((tmp_path, ended), "whole")
    ended = two_ranks.run_on_ranks(tmp_path, cache, "killed")
    assert [rank.returncode == 0 for rank in ended] == [False, False]
    assert newest(tmp_path / "interrupted" / "checkpoints").name == "step-2.ckpt"
    results((tmp_path, two_ranks.run_on_ranks(tmp_path, cache, "resumed")), "resumed")
    paths = [tmp_path / name / "checkpoints" / "step-6.ckpt" for name in ("whole", "interrupted")]
    whole, resumed = map(read_checkpoint, paths)
    for key in ("state_dict", "optimizer_states", "lr_schedulers"):
        assert_equal(whole[key], resumed[key], key)


@pytest.mark.slow
def test_three_hundred_windows_on_any_number_of_processes(tmp_path: Path, cache: Path) -> None:
    """Every metric is the same float on one, two and four, and so is every printed digit."""
    one = two_ranks.windows(tmp_path, cache)
    assert {"psnr", "abs_rel", "cv"} <= one.keys()
    for ranks in (2, 4):
        folder = tmp_path / str(ranks)
        folder.mkdir()
        ended = two_ranks.run_on_ranks(folder, cache, "windows", ranks=ranks)
        assert results((folder, ended), "windows", ranks) == [one] * ranks


@pytest.mark.slow
def test_forty_steps_on_two_processes(tmp_path: Path, cache: Path) -> None:
    """The ranks stay equal to the bit."""
    names = ("adamw_long", "muon_long")
    ended = two_ranks.run_on_ranks(tmp_path, cache, *names, timeout=1500)
    for name in names:
        one, two = results((tmp_path, ended), name)
        assert torch.equal(one["weights"], two["weights"])
        assert one["losses"] == two["losses"]
