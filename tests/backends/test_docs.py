"""examples/backend.py passes the contract test, as docs/guides/backend.md says."""

from tests.commands import ROOT, run_python

RUN = """
import sys, pytest
chosen = ["tests/backends/test_contract.py", "--backend", "examples.backend.LocalDepthBackend"]
sys.exit(pytest.main([*chosen, "-n", "0", "-p", "no:cacheprovider"]))
"""


def test_example_passes_the_contract() -> None:
    result = run_python(RUN, folder=ROOT)
    assert result.returncode == 0, result.stdout
    assert " passed" in result.stdout
    assert "skipped" not in result.stdout
