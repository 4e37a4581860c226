"""``vg2gt doctor`` says what it found on this machine."""

import re
from pathlib import Path

import pytest
import torch

import vg2gt
from vg2gt.cli import doctor


def test_doctor(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("VG2GT_CACHE", str(tmp_path))
    monkeypatch.setattr(doctor, "SECONDS", 0.1)
    monkeypatch.setattr(doctor, "BENCHMARK", {"cpu": (500, 1), "cuda": (500, 1)})
    doctor.main([])
    shown = capsys.readouterr().out
    assert re.search(rf"vg2gt +{re.escape(vg2gt.__version__)} \({re.escape(vg2gt.source())}\), Python", shown)
    assert f"torch {torch.__version__}" in shown
    assert str(tmp_path) in shown
    assert re.search(r"renderer +auto is 'cpu'\n", shown)
    assert re.search(r"speed +[\d.]+ ms for 500 Gaussians", shown)
    assert re.search(r"gpu ", shown)
    doctor.main(["--no-speed"])
    assert "speed" not in capsys.readouterr().out
