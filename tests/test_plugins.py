"""A package of its own adds a backend and a data set by entry points (examples/plugin)."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.commands import FRESH, ROOT, run_python
from vg2gt.runs.untrusted import UntrustedError, check_targets

CODE = """
sys.path.insert(0, sys.argv.pop(1))
import torch
from pathlib import Path
from tests.data.sources.layout_rgbd import write_recording
from tests.data.sources.layouts import room
from vg2gt.config import compose
from vg2gt.runs.load import load_model
from vg2gt.training.loop import build
import vg2gt.cli
root = Path(sys.argv.pop(1))
shown = room(12)
write_recording(root / "data", shown)
assert load_model(backend="bright", device="cpu").model.backend.name == "bright"
run = build(compose("train", "output_dir=.", "data=centimetres", f"data.root={root / 'data'}", *sys.argv[2:]))
run.datamodule.setup("fit")
batch = next(iter(run.datamodule.train_dataloader()))
depth, truth = batch.depth[batch.depth > 0], shown.depth[shown.depth > 0]
assert 5 < depth.median() / truth.median() < 20, (depth.median(), truth.median())
vg2gt.cli.main()
print("again", load_model("outputs/plugin", device="cpu").model.backend.name)
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the package is installed."""
    pytest.importorskip("hatchling")
    target = tmp_path_factory.mktemp("site")
    install = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation", "--no-index"]
    done = subprocess.run([*install, "--target", str(target), str(ROOT / "examples" / "plugin")], capture_output=True)
    assert done.returncode == 0, done.stderr
    return target


def test_a_package_adds_a_backend_and_a_data_set(site: Path, tmp_path: Path) -> None:
    """Trains a step with both, and its run is loaded again without a word of trust."""
    small = ["data.image_size=[28,56]", "data.min_views=2", "data.max_views=2", "data.max_images=2"]
    small += ["data.target_views=1", "data.eval_context=2", "data.eval_target=1", "data.index_cache=null"]
    small += ["trainer.max_steps=1", "trainer.accelerator=cpu", "name=plugin"]
    options = [f"data.root={tmp_path / 'data'}", *small]
    arguments = [str(site), str(tmp_path), "train", "backend=bright", "data=centimetres", *options]
    done = run_python(FRESH + CODE, *arguments, folder=tmp_path)
    assert done.returncode == 0, done.stdout[-1500:] + done.stderr[-3000:]
    assert done.stdout.strip().endswith("again bright"), done.stdout[-1500:]


def test_what_a_package_declares_is_trusted_and_nothing_else_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vg2gt.runs.untrusted.plugin_targets", lambda: {"backend": {"b": "some_pkg.B"}, "data": {}})
    check_targets({"_target_": "some_pkg.B"}, "config.yaml: backend")
    with pytest.raises(UntrustedError, match=r"some_pkg\.system"):
        check_targets({"_target_": "some_pkg.system"}, "config.yaml: backend")
