"""The sources execute nothing that they read; ruff's rules (pyproject.toml) say so of what these patterns do not."""

import re

from tests.commands import ROOT

PLACES = ("vg2gt", "backends", "benchmarks", "examples", "recipes")
FORBIDDEN = re.compile(
    r"weights_only=(?!True\b)|allow_pickle=(?!False\b)|load_from_checkpoint\(|register_custom_ops_library\("
    r"|enable_unsafe_deserialization\(|(?<![\w.])compile\(|np\.load\((?![^)]*allow_pickle=False)"
    r"|(?:torch\.load|load_state_dict_from_url)\((?!(?:[^()]|\([^)]*\))*weights_only=True)"
    r"|from (?:torch|numpy|torch\.hub) import [^\n]*\bload"  # under a name of its own it would not be found
)


def test_patterns_find_their_fault() -> None:
    faults = ("torch.load(path)", "torch.load(p, weights_only=flag)", "np.load(path)", "M.load_from_checkpoint(p)")
    for fault in (*faults, "from torch import load"):
        assert FORBIDDEN.search(fault), fault
    assert not FORBIDDEN.search("torch.load(open(path), weights_only=True)")


def test_sources() -> None:
    files = [ROOT / "train.py", *(path for place in PLACES for path in (ROOT / place).rglob("*.py"))]
    found = {path.name: FORBIDDEN.findall(path.read_text()) for path in files}
    assert {name: faults for name, faults in found.items() if faults} == {}
