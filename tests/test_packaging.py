"""The wheel works without the checkout."""

import os
import re
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest
import yaml

import vg2gt
from tests.commands import ROOT
from tests.training_helpers import small_config
from vg2gt.training.loop import build


@pytest.mark.parametrize("renderer", ["dense", pytest.param("auto", marks=pytest.mark.slow)])
def test_installed_wheel_trains_from_an_empty_folder(tmp_path: Path, cache: Path, renderer: str) -> None:
    """With kernels in the slow case: they are compiled again for a package in another folder."""
    making = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path / "dist")]
    subprocess.run(making, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    members = zipfile.ZipFile(wheel).namelist()
    assert {path.relative_to(ROOT).as_posix() for path in ROOT.glob("vg2gt/**/*.py")} <= set(members)
    assert "vg2gt/configs/train.yaml" in members
    assert "backends/oracle.py" in members
    assert "vg2gt/viewer/static/page.html" in members
    if vg2gt.source() != "unknown":  # of a checkout
        assert zipfile.ZipFile(wheel).read("vg2gt/SOURCE").decode().strip() == vg2gt.source()
    weights = [info for info in zipfile.ZipFile(wheel).infolist() if info.filename.endswith(".safetensors")]
    shipped = {"backends/sweep/weights/sweep.safetensors", "vg2gt/weights/sweep-tiny.safetensors"}
    assert {info.filename for info in weights} == shipped
    assert sum(info.file_size for info in weights) < 12e6
    assert not [name for name in members if name.startswith(("tests/", "benchmarks/", "outputs/"))]
    site, empty = tmp_path / "site", tmp_path / "empty"
    empty.mkdir()
    zipfile.ZipFile(wheel).extractall(site)
    # -S and an explicit path keep the checkout's editable install out.
    paths = [str(site), *(path for path in sys.path if path.endswith("site-packages"))]
    rooms = cache if renderer == "dense" else tmp_path / "rooms"
    small = ["trainer.fast_dev_run=true", "data.image_size=[28,56]", "data.train_scenes=1", "data.eval_scenes=1"]
    small += [f"renderer.implementation={renderer}", f"data.cache_dir={rooms}"]
    if renderer == "dense":
        data = build(small_config(tmp_path / "here", rooms, *small)).datamodule
        data.setup("fit")
        for loader in (data.train_dataloader(), data.val_dataloader()):
            next(iter(loader))  # renders the rooms
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    script = "import vg2gt, vg2gt.cli; print(vg2gt.__file__); vg2gt.cli.main()"
    run = subprocess.run(
        [sys.executable, "-S", "-c", script, "train", *small],
        cwd=empty,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr[-3000:]
    assert str(site) in run.stdout
    assert (empty / "outputs" / "trials" / "quickstart").is_dir()


@pytest.mark.slow
def test_the_lowest_versions_do(tmp_path: Path) -> None:
    """In an environment of its own, torch and its libraries included: gigabytes, from a package index."""
    text = (ROOT / "pyproject.toml").read_text()
    lists = [text.split(f"{name} = [")[1].split("]\n")[0] for name in ("dependencies", "\ntest")]
    needed, tools = (re.findall('"(.+)"', entries) for entries in lists)
    used = ("pytest", "av", "huggingface_hub", "pycolmap", "tensorboard")  # by the tests below
    needed += [tool for tool in tools if tool.startswith(used)]
    lowest = [re.sub(r"^([a-z_-]+)>=([0-9.]+)[^;]*", r"\1==\2", dependency) for dependency in needed]
    assert all("==" in dependency for dependency in lowest), needed
    venv.create(tmp_path / "lowest", with_pip=True)
    python = tmp_path / "lowest" / "bin" / "python"
    install = [str(python), "-m", "pip", "install", "-q", *lowest]
    installed = subprocess.run(install, capture_output=True, text=True, check=False)
    if "No matching distribution" in installed.stderr:
        pytest.skip(f"a lowest version is not to be had for this Python: {installed.stderr.strip().splitlines()[-1]}")
    assert installed.returncode == 0, installed.stderr[-3000:]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "VG2GT_CACHE": str(tmp_path / "cache")}
    tests = ["tests/io", "tests/geometry", "tests/runs", "tests/test_configs.py", "tests/safety/test_archives.py"]
    small = ["trainer.fast_dev_run=true", "data.image_size=[56,112]", "data.train_scenes=1", "data.eval_scenes=1"]
    suite, training = ["-m", "pytest", "-q", "-p", "no:cacheprovider", *tests], [str(ROOT / "train.py"), *small]
    for command, folder in ((suite, ROOT), (training, tmp_path)):
        ran = subprocess.run(
            [str(python), *command], cwd=folder, env=environment, capture_output=True, text=True, check=False
        )
        assert ran.returncode == 0, (ran.stdout + ran.stderr)[-5000:]


def test_container_and_hosted_ci_name_what_is_there() -> None:
    """Item 34 of issue 47."""
    project = (ROOT / "pyproject.toml").read_text()
    container = (ROOT / "Dockerfile").read_text()
    (extras,) = re.findall(r"/src\[(.+?)\]", container)
    assert all(re.search(rf"^{extra} = \[", project, re.MULTILINE) for extra in extras.split(","))
    (torch,) = re.findall(r'"(torch>.+?)"', container)
    assert f'"{torch}"' in project
    jobs = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())["jobs"]
    assert {"run": ".ci/run"} in jobs["linux"]["steps"]
    (tried,) = [step["run"] for step in jobs["others"]["steps"] if step.get("run", "").startswith("pytest")]
    assert all((ROOT / folder).is_dir() for folder in tried.split()[1:])
    assert os.access(ROOT / ".ci" / "run", os.X_OK)
