"""Every option of the group names exactly the arguments of its constructor."""

import inspect

import pytest
from hydra.utils import get_class
from omegaconf import DictConfig

from backends.published import NETWORKS
from tests.training_helpers import group_options

OPTIONS = [name for name in group_options("backend") if name != "custom"]
NON_COMMERCIAL = {"da3_large", "da3_giant", "da3_nested_giant"}


def check_signature(config: DictConfig) -> None:
    parameters = inspect.signature(get_class(config._target_)).parameters
    needed = {
        name
        for name, parameter in parameters.items()
        if parameter.default is parameter.empty and parameter.kind is not parameter.VAR_KEYWORD
    }
    assert needed <= set(config) - {"_target_"} <= set(parameters)
    for value in config.values():
        if isinstance(value, DictConfig):
            check_signature(value)


@pytest.mark.parametrize("name", OPTIONS)
def test_yaml_is_the_signature(load_config, name: str) -> None:
    check_signature(load_config(name))


@pytest.mark.parametrize("name", sorted(set(OPTIONS) & NETWORKS.keys()))
def test_an_option_has_the_name_of_its_network(load_config, name: str) -> None:
    assert load_config(name).name == name


def test_licences_are_stated() -> None:
    assert {name for name, network in NETWORKS.items() if "NC" in network["licence"]} == NON_COMMERCIAL


def test_other_shapes_and_unknown_attributes(make_backend) -> None:
    assert make_backend("da3_tiny", "depth=4", "multiview_from=1", "taps=[0,1,2,3]").taps == (0, 1, 2, 3)
    with pytest.raises(Exception, match="unexpected keyword argument 'width'"):
        make_backend("da3_tiny", "width=4")
    with pytest.raises(
        Exception, match=r"backend\.name=mine is none of da3_small.*: give its dim, depth, num_heads, taps"
    ):
        make_backend("da3_tiny", "name=mine")


def test_custom_takes_any_class(make_backend) -> None:
    assert make_backend("custom", "_target_=backends.oracle.OracleBackend").name == "oracle"
    with pytest.raises(Exception, match="abstract class Backend"):
        make_backend("custom")
