"""Every preset composes, fits its constructors and holds what the paper says."""

import subprocess
import sys
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.utils import get_class, instantiate
from omegaconf import DictConfig

from vg2gt.config import config_dir
from vg2gt.data.views.drawn import index_path
from vg2gt.evaluation import EvaluationOptions, paper

PRESETS = sorted(path.stem for path in (Path(config_dir()) / "evaluation").glob("*.yaml"))


def composed(preset: str) -> DictConfig:
    root = {"synthetic": [], "dtu": ["data.val.root=somewhere"]}.get(preset, ["data.root=somewhere"])
    with initialize_config_dir(config_dir(), version_base="1.3"):
        return compose(
            "evaluate", [f"evaluation={preset}", "name=x", "output_dir=x", "hydra/job_logging=default", *root]
        )


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_instantiate(preset: str) -> None:
    config = composed(preset)
    options: EvaluationOptions = instantiate(config.evaluation, _convert_="all")
    assert list(config.views) == [3, 10, 20]
    assert config.data._target_ == "vg2gt.data.SceneDataModule"
    if options.selection.index is not None:
        assert index_path(options.selection.index).is_file()
    if options.table is not None:
        assert any(options.table in table for table in paper.tables().values())


@pytest.mark.parametrize("preset", sorted({"replica", "dtu", "tat", "scannet"} & set(PRESETS)))
def test_the_papers_presets_are_the_papers(preset: str) -> None:
    config = composed(preset)
    options: EvaluationOptions = instantiate(config.evaluation, _convert_="all")
    assert options.table == preset
    read = {
        "source": get_class(config.data.val._target_).__name__,
        "size": (config.data.image_size[0], config.data.image_size[1]),
        "fit": config.data.fit,
        "alignment": options.alignment,
        "depth_range": options.depth_range,
    }
    assert paper.obstacle(preset, **read, told=False) is None
    assert paper.obstacle(preset, **read, told=True) is not None


def test_dtu_is_compared_with_its_own_options() -> None:
    options: EvaluationOptions = instantiate(composed("dtu").evaluation, _convert_="all")
    assert options.selection.fixed == {3: [23, 24, 33]}
    assert (options.points.downsample, options.points.cap) == (0.0002, 0.02)  # 0.2 mm, 20 mm


def test_a_wrong_option_is_one_line(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "vg2gt.evaluate", "evaluation.alignment=affine"]
    run = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=120, check=False)
    assert run.returncode != 0
    assert run.stderr.strip().splitlines() == [
        "ValueError: evaluation.alignment='affine': choose one of median, scene, wmed, scale_shift, none",
        "(HYDRA_FULL_ERROR=1 shows where)",
    ]
