"""Where a run's files go: named by what was chosen, never over another run, never outside ``outputs``."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from vg2gt.cli import folders

DEFAULT = {"data": "synthetic", "backend": "oracle", "model": "tiny", "experiment": None, "ablation": None}


@pytest.fixture(autouse=True)
def empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.chdir(tmp_path)
    folders.register()
    for variable in folders.STARTED_BY_OTHERS:
        monkeypatch.delenv(variable, raising=False)
    yield
    folders.free.cache_clear()


def folder(choices: dict[str, Any] | None = None, mode: str = "RUN", trial: bool = False, **keys: Any) -> str:
    """The folder that a new process gives to a run."""
    folders.free.cache_clear()
    content = {
        "name": None, "ckpt": None, "overwrite": False, "trainer": {"fast_dev_run": trial}, "at": "${run_folder:}",
        "hydra": {"mode": mode, "runtime": {"choices": DEFAULT | (choices or {})}},
    }  # fmt: skip
    return OmegaConf.create(content | keys).at


def ran(name: str) -> None:
    Path("outputs", name).mkdir(parents=True)
    Path("outputs", name, "config.yaml").touch()


def test_runs_are_named_by_what_was_chosen() -> None:
    assert (folder(), folder({"data": "rgbd"})) == ("quickstart", "rgbd-oracle-tiny")
    assert folder({"experiment": "paper", "data": "paper_mix"}) == "paper_mix-oracle-tiny-paper"
    assert (folder({"data": "rgbd"}, name="mine"), folder(trial=True)) == ("mine", "trials/quickstart")
    assert folder(mode="MULTIRUN") == "sweep"


def test_a_taken_name_gets_a_number_unless_it_is_meant(monkeypatch: pytest.MonkeyPatch) -> None:
    Path("outputs/quickstart").mkdir(parents=True)  # a start that was refused left no run
    assert folder() == "quickstart"
    ran("mine")
    ran("sweep/0")
    ran("rgbd-oracle-tiny")
    ran("rgbd-oracle-tiny-2")
    assert (folder({"data": "rgbd"}), folder(mode="MULTIRUN")) == ("rgbd-oracle-tiny-3", "sweep-2")
    assert folder({"data": "rgbd"}, overwrite=True) == "rgbd-oracle-tiny"
    for ckpt in ("auto", "last"):
        assert folder({"data": "rgbd"}, ckpt=ckpt) == "rgbd-oracle-tiny"
    assert folder(name="mine") == "mine"
    monkeypatch.setenv("RANK", "1")  # every process of a job must find the same name
    assert folder({"data": "rgbd"}) == "rgbd-oracle-tiny"


def test_names_are_taken_as_they_are_and_do_not_lead_out() -> None:
    for name in ("mine", "paper/first", "ein Name", "名前", "..x", "12:30"):
        assert folder(name=name) == name
    for name in ("../x", "a/../../x", "/x", "..", ""):
        with pytest.raises(OmegaConfBaseException, match=re.escape(f"name={name} must be a path inside outputs")):
            folder(name=name)
