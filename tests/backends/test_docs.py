"""The example of docs/add-a-backend.md passes the contract test, as it says there."""

import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_example_passes_the_contract(tmp_path: Path) -> None:
    text = (ROOT / "docs" / "add-a-backend.md").read_text()
    match = re.search(r"```python\n(.*?)```", text, re.DOTALL)
    assert match
    code = match.group(1)
    assert len(code.splitlines()) <= 40
    (tmp_path / "my_pkg.py").write_text(code)
    path = os.pathsep.join((str(tmp_path), str(ROOT), os.environ.get("PYTHONPATH", "")))
    command = [sys.executable, "-m", "pytest", "tests/backends/test_contract.py", "-n", "0", "-p", "no:cacheprovider"]
    result = subprocess.run(
        [*command, "--backend", "my_pkg.LocalDepthBackend"],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stdout
    assert " passed" in result.stdout
    assert "skipped" not in result.stdout
