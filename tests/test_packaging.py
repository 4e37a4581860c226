"""The wheel works without the checkout."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def test_installed_wheel_trains_from_an_empty_folder(tmp_path: Path) -> None:
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path / "dist"), str(ROOT)]
    subprocess.run(build, check=True, capture_output=True)
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    members = zipfile.ZipFile(wheel).namelist()
    assert "vg2gt/configs/train.yaml" in members
    assert "backends/oracle.py" in members
    assert "vg2gt/viewer/static/page.html" in members
    assert not [name for name in members if name.startswith(("tests/", "benchmarks/", "outputs/"))]

    site, empty = tmp_path / "site", tmp_path / "empty"
    empty.mkdir()
    install = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-index", "--target", str(site), str(wheel)]
    subprocess.run(install, check=True, capture_output=True)
    # -S and an explicit path keep the checkout's editable install out.
    paths = [str(site), *(path for path in sys.path if path.endswith("site-packages"))]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "VG2GT_CACHE": str(tmp_path / "cache")}
    small = ["debug=fast_dev_run", "data.image_size=[56,112]", "data.train_scenes=1", "data.eval_scenes=1"]
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
