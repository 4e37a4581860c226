import pytest
import torch

from tests.references import draw_weights, read_cases, read_json
from vg2gt.method import PTv3

SIZE = torch.full((2,), 0.125)


def features_of(grid, channels=8):
    return torch.randn(len(grid), channels, dtype=torch.float64, generator=torch.Generator().manual_seed(1))


def test_orders_are_shuffled_in_training_only_and_from_the_generator(random_voxels, make_ptv3):
    grid, batch = random_voxels()
    features, net = features_of(grid), make_ptv3().double()

    def run(seed):
        generator = None if seed is None else torch.Generator().manual_seed(seed)
        return net(features, grid, batch, SIZE, generator=generator)

    net.train()
    results = [run(seed) for seed in range(4)]
    assert torch.equal(results[0], run(0))
    assert any(not torch.equal(results[0], other) for other in results[1:])
    assert torch.equal(run(None), net.eval()(features, grid, batch, SIZE))
    assert torch.equal(run(0), run(1))


def test_drop_path_acts_in_training_only(random_voxels, make_ptv3):
    grid, batch = random_voxels()
    features, net = features_of(grid), make_ptv3(drop_path=0.5).double()
    torch.manual_seed(0)
    first = net(features, grid, batch, SIZE)
    assert not torch.equal(first, net(features, grid, batch, SIZE))
    net.eval()
    assert torch.equal(net(features, grid, batch, SIZE), make_ptv3().double().eval()(features, grid, batch, SIZE))


def test_legacy_changes_the_first_decoder_block_only(random_voxels, make_ptv3):
    grid, batch = random_voxels()
    features, net = features_of(grid), make_ptv3().double().eval()
    plain = net(features, grid, batch, SIZE)
    net.legacy = True
    assert not torch.allclose(plain, net(features, grid, batch, SIZE))
    for stage in net.dec.values():
        conv = stage["block0"].cpe[0]
        torch.nn.init.zeros_(conv.weight)
    net.legacy = False
    without = net(features, grid, batch, SIZE)
    net.legacy = True
    assert torch.equal(without, net(features, grid, batch, SIZE))


@pytest.mark.parametrize("case", [0, 1])
def test_equals_the_official_code(case):
    net = PTv3(**read_json("networks")["ptv3_tiny"]["config"], norm="batch", legacy=True).eval()
    counters = {name: value for name, value in net.state_dict().items() if name.endswith("num_batches_tracked")}
    net.load_state_dict(draw_weights("ptv3_tiny") | counters)
    features, grid, batch, expected = (
        read_cases("ptv3_tiny")[f"{case}.{name}"] for name in ("features", "grid", "batch", "output")
    )
    out = net(features, grid, batch, torch.ones(case + 1))
    assert (out - expected).abs().max() <= 2e-5 * expected.abs().max()


def test_state_dict_has_the_official_names():
    with torch.device("meta"):
        net = PTv3(norm="batch")
    names = {name: tuple(value.shape) for name, value in net.state_dict().items()}
    expected = {
        "embedding.stem.conv.weight": (128, 5, 5, 5, 1024),
        "embedding.stem.norm.running_mean": (128,),
        "enc.enc0.block0.cpe.0.weight": (128, 3, 3, 3, 128),
        "enc.enc0.block0.cpe.0.bias": (128,),
        "enc.enc0.block1.cpe.1.weight": (128, 128),
        "enc.enc0.block1.cpe.2.weight": (128,),
        "enc.enc3.block5.attn.qkv.weight": (768, 256),
        "enc.enc3.block5.attn.proj.bias": (256,),
        "enc.enc1.block0.norm1.0.weight": (128,),
        "enc.enc1.block0.norm2.0.bias": (128,),
        "enc.enc4.block1.mlp.0.fc1.weight": (2048, 512),
        "enc.enc4.block1.mlp.0.fc2.weight": (512, 2048),
        "enc.enc1.down.proj.weight": (128, 128),
        "enc.enc4.down.norm.0.running_var": (512,),
        "dec.dec3.up.proj.0.weight": (256, 512),
        "dec.dec3.up.proj.1.weight": (256,),
        "dec.dec0.up.proj_skip.0.weight": (1024, 128),
        "dec.dec0.up.proj_skip.1.bias": (1024,),
        "dec.dec0.block1.attn.qkv.weight": (3072, 1024),
    }
    assert expected.items() <= names.items()
    assert "enc.enc0.down.proj.weight" not in names
    assert net.out_channels == 1024
