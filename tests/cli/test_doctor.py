"""``vg2gt doctor`` says what it found on this machine."""

import re
from pathlib import Path

import pytest
import torch

import vg2gt
from vg2gt.cli import doctor


def test_doctor(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("VG2GT_CACHE", str(tmp_path))
    doctor.main([])
    shown = capsys.readouterr().out
    assert re.search(rf"vg2gt +{re.escape(vg2gt.__version__)} \({re.escape(vg2gt.source())}\), Python", shown)
    assert f"torch {torch.__version__}" in shown
    assert str(tmp_path) in shown
    assert re.search(r"renderer +auto is 'cpu'\n", shown)
    assert re.search(r"gpu ", shown)
