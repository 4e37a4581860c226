"""Every preset composes, fits its constructors and holds what the paper says."""

import pytest
from hydra.utils import get_class, instantiate
from omegaconf import DictConfig

from tests.commands import ROOT
from tests.training_helpers import group_options
from vg2gt.config import compose
from vg2gt.data.views.drawn import index_path
from vg2gt.evaluation import paper
from vg2gt.evaluation.evaluator import EvaluationOptions

EXAMPLES = ROOT / "examples" / "data_sets" / "configs"
PLUGINS = sorted(path.stem for path in (EXAMPLES / "evaluation").iterdir())
PRESETS = [*group_options("evaluation"), *PLUGINS]


def composed(preset: str) -> DictConfig:
    root = {"synthetic": [], "dtu": ["data.val.root=somewhere"]}.get(preset, ["data.root=somewhere"])
    plugin = [f"hydra.searchpath=[{EXAMPLES}]"] if preset in PLUGINS else []
    return compose("evaluate", *plugin, f"evaluation={preset}", "name=x", "output_dir=x", *root)


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_instantiate(preset: str) -> None:
    config = composed(preset)
    options: EvaluationOptions = instantiate(config.evaluation, _convert_="all")
    assert (list(config.views), config.data._target_) == ([3, 10, 20], "vg2gt.data.SceneDataModule")
    if options.selection.index is not None:
        assert index_path(options.selection.index).is_file()
    if options.table is not None:
        assert any(options.table in table for table in paper.tables().values())


@pytest.mark.parametrize("preset", sorted({"replica", "scannet", *PLUGINS}))
def test_the_papers_presets_are_the_papers(preset: str) -> None:
    config = composed(preset)
    options: EvaluationOptions = instantiate(config.evaluation, _convert_="all")
    assert options.table == preset
    read = {
        "data": get_class(config.data.val._target_).__name__,
        "size": (config.data.image_size[0], config.data.image_size[1]),
        "alignment": options.alignment,
        "depth_range": options.depth_range,
    }
    assert paper.obstacle(preset, read | {"told": False}) is None
    assert paper.obstacle(preset, read | {"told": True}) is not None
