"""Every YAML of the group names exactly the arguments of its constructor."""

import inspect
from pathlib import Path

import pytest
from hydra.utils import get_class
from omegaconf import DictConfig

FOLDER = Path(__file__).resolve().parents[2] / "configs" / "backend"
FILES = sorted(path.stem for path in FOLDER.glob("*.yaml") if path.stem != "custom")
NON_COMMERCIAL = {"da3_large", "da3_giant"}


def check_signature(config: DictConfig) -> None:
    parameters = inspect.signature(get_class(config._target_).__init__).parameters
    needed = {name for name, parameter in parameters.items() if parameter.default is parameter.empty} - {"self"}
    assert needed <= set(config) - {"_target_"} <= set(parameters)
    for value in config.values():
        if isinstance(value, DictConfig):
            check_signature(value)


@pytest.mark.parametrize("name", FILES)
def test_yaml_is_the_signature(load_config, name: str) -> None:
    check_signature(load_config(name))


@pytest.mark.parametrize("name", sorted(set(FILES) - {"oracle", "onnx", "sweep"}))
def test_licence_and_name_are_stated(load_config, name: str) -> None:
    config = load_config(name)
    assert config.name == name
    if "licence" in config:
        assert ("NC" in config.licence) == (name in NON_COMMERCIAL)


def test_custom_takes_any_class(make_backend) -> None:
    assert make_backend("custom", "_target_=backends.oracle.OracleBackend").name == "oracle"
    with pytest.raises(Exception, match="abstract class Backend"):
        make_backend("custom")
