"""What the configuration in a checkpoint or a run's config.yaml names is not called."""

import logging
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from vg2gt.config import compose_groups, config_dir, variants
from vg2gt.evaluation.checks import refuse_training_views
from vg2gt.runs.checkpoints import MADE_OF
from vg2gt.runs.load import load_model, refuse_other_tokens
from vg2gt.runs.untrusted import ENVIRONMENT, UntrustedError, check_targets
from vg2gt.studies.study import _refuse_other_run
from vg2gt.training.start import name_differences

Attack = Callable[[str], dict[str, Any]]

ATTACKS: dict[str, Attack] = {
    "os.system": lambda c: {"_target_": "os.system", "_args_": [f"touch {c}"]},
    "partial": lambda c: {"_target_": "os.mkdir", "_partial_": True, "path": c},
    "nested": lambda c: {"_target_": "vg2gt.model.SceneScale", "source": {"_target_": "os.mkdir", "path": c}},
    "not recursive": lambda c: {**ATTACKS["nested"](c), "_recursive_": False},
    "through a module of ours": lambda c: {"_target_": "vg2gt.kernels.threads.os.mkdir", "path": c},
    "a function of ours": lambda c: {"_target_": "vg2gt.io.files.write_text", "path": c, "content": ""},
    "a class that writes": lambda c: {"_target_": "vg2gt.training.checkpointing.StopOnSignal", "folder": c},
    "a list": lambda c: [{"_target_": "os.mkdir", "path": c}],  # pyright: ignore[reportAssignmentType]
}  # fmt: skip


def rewrite(run_folder: Path, text: str) -> None:
    """Changes the configuration that the run's checkpoint stores."""
    path = run_folder / "checkpoints" / "step-7.ckpt"
    torch.save(torch.load(path, weights_only=True) | {MADE_OF: text}, path)


def edit(run_folder: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Changes the same configuration as a dictionary."""
    config: Any = OmegaConf.to_container(OmegaConf.load(run_folder / "config.yaml"))
    change(config)
    rewrite(run_folder, OmegaConf.to_yaml(OmegaConf.create(config)))


@pytest.mark.parametrize("attack", ATTACKS)
def test_a_runs_configuration_calls_nothing_foreign(run_folder: Path, canary: Path, attack: str, monkeypatch) -> None:
    monkeypatch.setattr("socket.socket.connect", lambda *_: pytest.fail("a connection was opened"))
    edit(run_folder, lambda config: config.update(backend=ATTACKS[attack](str(canary))))
    with pytest.raises(UntrustedError, match=r"step-7\.ckpt: config\.backend.*_target_ is .*VG2GT_TRUST=PACKAGE"):
        load_model(run_folder, device="cpu")


@pytest.mark.parametrize("place", ["renderer", "voxel_size"])
def test_wherever_it_stands(run_folder: Path, canary: Path, place: str) -> None:
    attack = {place: {"_target_": "os.mkdir", "path": str(canary)}}
    edit(run_folder, lambda config: (config["model"]["fine"] if place == "voxel_size" else config).update(attack))
    for overrides in ([], ["renderer.near=0.5", "model.fine.max_voxels=5"]):  # other changes do not hide it
        with pytest.raises(UntrustedError, match=r"_target_ is 'os\.mkdir'"):
            load_model(run_folder, device="cpu", overrides=overrides)


def test_the_runs_data_call_nothing_foreign(run_folder: Path, canary: Path, rooms, caplog) -> None:
    """An evaluation only needs to know the training data: it warns that it cannot, and continues."""
    with (run_folder / "config.yaml").open("a") as file:
        file.write(f"data: {{_target_: os.mkdir, path: {canary}}}\n")
    refuse_training_views(run_folder / "checkpoints" / "step-7.ckpt", rooms, [])
    assert "cannot check whether" in caplog.text
    assert "data._target_ is 'os.mkdir'" in caplog.text


def test_what_the_user_names_is_called(run_folder: Path) -> None:
    """Untrusted is the file, not the command line."""
    edit(run_folder, lambda config: config.update(renderer={"_target_": "os.mkdir", "path": "nowhere"}))
    with pytest.raises(UntrustedError):
        load_model(run_folder, overrides=["backend=oracle", "model=tiny"], device="cpu")
    changed = {"backend": {"_target_": "os.mkdir"}, "renderer": {"_target_": "vg2gt.rendering.Renderer"}}
    edit(run_folder, lambda config: config.update(changed))
    assert load_model(run_folder, "oracle", ["backend.depth_noise=0"], device="cpu").weights.step == 7


def test_defaults_of_a_stored_backend_import_nothing_foreign(tmp_path: Path) -> None:
    """Also of a part of it."""
    (tmp_path / "some_evil_pkg.py").write_text("class Net: pass\n")
    own = OmegaConf.create(OmegaConf.to_container(compose_groups("backend=da3_nested").backend))
    stored = OmegaConf.merge(own, {"metric": {"_target_": "some_evil_pkg.Net"}})
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(tmp_path)
        refuse_other_tokens(own, {MADE_OF: OmegaConf.to_yaml({"backend": stored})}, tmp_path)
    assert "some_evil_pkg" not in sys.modules
    stored = OmegaConf.merge(own, {"relative": {"taps": [1, 2, 3, 4]}})
    with pytest.raises(ValueError, match=r"backend\.relative\.taps=\[1, 2, 3, 4\], but this run uses \[19, 27"):
        refuse_other_tokens(own, {MADE_OF: OmegaConf.to_yaml({"backend": stored})}, tmp_path)


YAMLS = {
    "object": ("!!python/object/apply:os.system ['touch {canary}']", "is not a run's configuration"),
    "module": ("!!python/module:antigravity ''", "is not a run's configuration"),
    "own tag": ("!evil 1", "is not a run's configuration"),
    "environment": ("${{oc.env:SECRET}}", "an interpolation"),
    "no YAML": ("{{", "is not a run's configuration"),
}


@pytest.mark.parametrize("name", YAMLS)
def test_a_runs_configuration_is_plain(run_folder, canary, name, monkeypatch):
    monkeypatch.setenv("SECRET", "hunter2")
    value, said = YAMLS[name]
    text = (run_folder / "config.yaml").read_text()
    rewrite(run_folder, f"{text}extra: {value.format(canary=canary) if '{' in value else value}\n")
    with pytest.raises(ValueError, match=rf"step-7\.ckpt: .*{said}") as caught:
        load_model(run_folder, device="cpu")
    assert "hunter2" not in str(caught.value)


@pytest.mark.parametrize(
    "read", [lambda config, run: name_differences(config, run / "checkpoints" / "last"), _refuse_other_run]
)
def test_no_command_reads_the_environment_for_a_runs_configuration(read, run_folder, monkeypatch, caplog):
    monkeypatch.setenv("SECRET", "hunter2")
    path = run_folder / "config.yaml"
    text = path.read_text()
    path.write_text(f"{text}${{oc.env:SECRET}}: 1\nx: ${{oc.env:SECRET}}\n")
    with caplog.at_level(logging.DEBUG), pytest.raises(UntrustedError, match="an interpolation") as caught:
        read(OmegaConf.create({"output_dir": str(run_folder)}), run_folder)
    assert "hunter2" not in caplog.text + str(caught.value)
    path.write_bytes(text.encode() + b"x: \xff\n")
    with pytest.raises(ValueError, match="is not a run's configuration"):
        read(OmegaConf.create({"output_dir": str(run_folder)}), run_folder)


def test_a_package_is_trusted_by_name(run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, model) -> None:
    """docs/guides/backend.md: training with an own backend, then reading the run."""
    (tmp_path / "my_own_pkg.py").write_text(
        "import os\nfrom backends.oracle import OracleBackend\nclass Mine(OracleBackend):\n    pass\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    edit(run_folder, lambda config: config["backend"].update(_target_="my_own_pkg.Mine"))
    with pytest.raises(UntrustedError, match=r"my_own_pkg\.Mine.*VG2GT_TRUST"):
        load_model(run_folder, device="cpu")
    assert "my_own_pkg" not in sys.modules  # not even imported
    monkeypatch.setenv(ENVIRONMENT, "other, my_own_pkg")
    assert type(load_model(run_folder, device="cpu").model.backend).__name__ == "Mine"
    edit(run_folder, lambda config: config["backend"].update(_target_="my_own_pkg.os.mkdir"))
    with pytest.raises(UntrustedError, match="not in my_own_pkg"):
        load_model(run_folder, device="cpu")
    monkeypatch.delitem(sys.modules, "my_own_pkg")


def test_everything_of_the_projects_configurations_is_trusted() -> None:
    for group in ("backend", "model", "renderer", "data"):
        files = sorted(Path(config_dir(), group).glob("*.yaml"))
        assert files
        for path in files:
            check_targets(OmegaConf.load(path), path)
        for name, option in variants().get(group, {}).items():
            check_targets(OmegaConf.create(option), name)
