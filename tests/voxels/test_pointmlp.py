import pytest
import torch

from vg2gt.method import PointMLP
from vg2gt.method.point_mlp import GeometricStage
from vg2gt.method.serialization import make_windows

SIZE = torch.full((2,), 0.125)


def network(**options):
    torch.manual_seed(0)
    return PointMLP(6, **{"channels": 16, "stages": 4, "window": 8, **options}).double()


def test_checkpointing_changes_no_gradient(random_voxels):
    grid, batch = random_voxels()
    features = torch.randn(len(grid), 6, dtype=torch.float64)
    grads = []
    for checkpoint in (False, True):
        net = network(checkpoint=checkpoint)
        net(features, grid, batch, SIZE).square().sum().backward()
        grads.append([p.grad for p in net.parameters()])
    torch.testing.assert_close(*grads)


def stage_as_written(stage, features, positions, windows, batch):
    """The stage with its affine written out, a window at a time."""
    updates = {}
    for group in windows.groups:
        scenes = batch[group.rows[:, 0]]
        for rows, scene in zip(group.rows, scenes, strict=True):
            values = torch.cat((features, positions), 1)[rows]
            sigmas = []
            for part in (features, positions):
                of_scene = part[group.rows[scenes == scene]]
                variance = (of_scene - of_scene.mean(1, keepdim=True)).square().mean()
                sigmas.append(((variance + 1e-10).sqrt() + 1e-5).expand(part.shape[1]))
            affine = stage.alpha * (values - values.mean(0)) / torch.cat(sigmas) + stage.beta
            hidden = stage.before(stage.inner(torch.cat((affine, features[rows]), 1)))
            context = stage.after(hidden.amax(0, keepdim=True)).expand_as(hidden)
            updates.setdefault(group.rows.shape[1], []).append(stage.out(torch.cat((hidden, context), 1)))
    update = torch.cat([torch.cat(rows) for rows in updates.values()])
    return features + stage.gamma * update[windows.owner]


@pytest.mark.parametrize("counts", [[140], [40, 200, 5], [8, 0, 8], [1]])
def test_a_stage_is_what_the_paper_says(counts):
    torch.manual_seed(0)
    stage = GeometricStage(6).double()
    for parameter in stage.parameters():
        torch.nn.init.normal_(parameter, std=0.5)
    batch = torch.arange(len(counts)).repeat_interleave(torch.tensor(counts))
    features = (3 + torch.randn(len(batch), 6, dtype=torch.float64)).requires_grad_()
    positions = torch.randint(0, 1000, (len(batch), 3)).double()
    order = torch.arange(len(batch))
    windows = make_windows(counts, 8, order.device, shift=4).along(order)
    outputs = [stage(features, positions, windows), stage_as_written(stage, features, positions, windows, batch)]
    torch.testing.assert_close(*outputs)
    inputs = [features, *stage.parameters()]
    torch.testing.assert_close(*(torch.autograd.grad(out.sin().sum(), inputs) for out in outputs))
