"""The example of docs/add-a-backend.md passes the contract test, as it says there."""

import re
from pathlib import Path

from tests.commands import ROOT, run_python

# PYTHONPATH=FOLDER pytest tests/backends/test_contract.py --backend my_pkg.LocalDepthBackend
RUN = """
import sys, pytest
sys.path.insert(0, sys.argv[1])
chosen = ["tests/backends/test_contract.py", "--backend", "my_pkg.LocalDepthBackend"]
sys.exit(pytest.main([*chosen, "-n", "0", "-p", "no:cacheprovider"]))
"""


def test_example_passes_the_contract(tmp_path: Path) -> None:
    text = (ROOT / "docs" / "add-a-backend.md").read_text()
    match = re.search(r"```python\n(.*?)```", text, re.DOTALL)
    assert match
    code = match.group(1)
    assert len(code.splitlines()) <= 40
    (tmp_path / "my_pkg.py").write_text(code)
    result = run_python(RUN, str(tmp_path), folder=ROOT)
    assert result.returncode == 0, result.stdout
    assert " passed" in result.stdout
    assert "skipped" not in result.stdout
