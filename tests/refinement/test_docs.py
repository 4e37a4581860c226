"""The commands and the example of docs/guides/refine.md run as written."""

import re
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from vg2gt.cli import main
from vg2gt.data.synthetic import SyntheticScenes

PAGE = Path(__file__).resolve().parents[2] / "docs" / "guides" / "refine.md"


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    source = SyntheticScenes(1, num_frames=4, size=(56, 84))
    frames = source.load(source.scenes[0], range(4))
    folder = tmp_path / "recording"
    for sub in ("images", "depth"):
        (folder / sub).mkdir(parents=True)
    for i in range(4):
        pixels = (frames.images[i].permute(1, 2, 0).numpy() * 255 + 0.5).astype(np.uint8)
        Image.fromarray(pixels).save(folder / "images" / f"{i}.png")
        Image.fromarray((frames.depth[i].numpy() * 1000 + 0.5).astype(np.uint16)).save(folder / "depth" / f"{i}.png")
    np.savetxt(folder / "poses.txt", np.linalg.inv(frames.world_to_camera.double().numpy()).reshape(-1, 16))
    np.savetxt(folder / "K.txt", frames.intrinsics[0].numpy())
    return folder


def test_page(recording: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    monkeypatch.chdir(recording.parent)
    commands = [shlex.split(line) for line in re.findall(r"^vg2gt .*", PAGE.read_text(), re.MULTILINE)]
    assert {words[1] for words in commands} == {"reconstruct", "refine"}
    for words in commands:
        short = ["2" if before == "--seconds" else word for before, word in zip(["", *words], words, strict=False)]
        monkeypatch.setattr(sys, "argv", [*short, "--quiet", "--device", "cpu"])
        main()
    assert (recording.parent / "outputs" / "start" / "refined" / "refine.png").is_file()
    assert (recording.parent / "outputs" / "sharp" / "refine.png").is_file()
    capsys.readouterr()
    for example in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL):
        exec(compile(example, str(PAGE), "exec"), {})
    assert capsys.readouterr().out == "True 1\nTrue\n"
