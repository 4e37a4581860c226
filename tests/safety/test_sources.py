"""The sources call nothing that would execute what they read, and build no command from strings."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PLACES = ("vg2gt", "backends", "benchmarks", "examples", "recipes")
FILES = [ROOT / "train.py", *sorted(path for place in PLACES for path in (ROOT / place).rglob("*.py"))]

FORBIDDEN = {
    *("eval", "exec", "compile", "builtins.eval", "builtins.exec"),
    *("os.system", "os.popen", "subprocess.getoutput", "subprocess.getstatusoutput", "pty.spawn"),
    *(f"{module}.{name}" for module in ("pickle", "dill", "cloudpickle", "marshal") for name in ("load", "loads")),
    *("pickle.Unpickler", "shelve.open", "joblib.load", "pandas.read_pickle"),
    *("yaml.load", "yaml.load_all", "yaml.full_load", "yaml.unsafe_load"),
    *("tempfile.mktemp", "torch.hub.load", "torch.jit.load", "torch.package.PackageImporter"),
    *("xml.etree.ElementTree.parse", "xml.dom.minidom.parse"),  # entities
    "Image.open",  # vg2gt.io.images.open_image: photographs' formats only
}
METHODS = {"extractall", "load_from_checkpoint", "register_custom_ops_library", "enable_unsafe_deserialization"}
NEEDED = {  # call: keyword with its only value
    "torch.load": ("weights_only", True),
    "torch.hub.load_state_dict_from_url": ("weights_only", True),
    "np.load": ("allow_pickle", False),
    "numpy.load": ("allow_pickle", False),
}
ALLOWED = {  # file: what it may call nevertheless, because there it is made safe
    "vg2gt/io/images.py": {"Image.open"},
    "vg2gt/data/synthetic/photograph.py": {"Image.open"},  # of what it has just compressed
}


def dotted(node: ast.expr) -> str:
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else "?"


def imported(tree: ast.AST) -> dict[str, str]:
    """What local names stand for: ``from os import system as run``, ``import pickle as p``."""
    names = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            names |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            names |= {alias.asname: alias.name for alias in node.names if alias.asname}
    return names


def complaints(source: str) -> Iterator[str]:
    tree = ast.parse(source)
    names = imported(tree)
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        written = dotted(node.func)
        first, dot, rest = written.partition(".")
        name = names.get(first, first) + dot + rest
        name = {"PIL.Image.open": "Image.open", "numpy.load": "np.load"}.get(name, name)
        name = "OmegaConf.load" if name == "omegaconf.OmegaConf.load" else name
        keywords = {item.arg: item.value for item in node.keywords}
        if name in FORBIDDEN or name == "OmegaConf.load":
            yield name
        if isinstance(node.func, ast.Attribute) and node.func.attr in METHODS:
            yield node.func.attr
        if "shell" in keywords and getattr(keywords["shell"], "value", True) is not False:
            yield "shell"
        if name.startswith("subprocess.") and node.args and isinstance(node.args[0], ast.JoinedStr | ast.Constant):
            yield "a command in one string"
        if name in NEEDED:
            keyword, value = NEEDED[name]
            if getattr(keywords.get(keyword), "value", None) is not value:
                yield name


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("eval('1')", "eval"),
        ("from os import system as run\nrun('ls')", "os.system"),
        ("import subprocess\nsubprocess.run(['ls'], shell=True)", "shell"),
        ("import subprocess\nsubprocess.run(f'ls {name}')", "a command in one string"),
        ("import pickle as p\np.loads(content)", "pickle.loads"),
        ("torch.load(path, weights_only=flag)", "torch.load"),
        ("from torch import load\nload(path)", "torch.load"),
        ("yaml.load(text, Loader=yaml.Loader)", "yaml.load"),
        ("np.load(path)", "np.load"),
        ("tarfile.open(path).extractall(folder)", "extractall"),
        ("VG2GTModule.load_from_checkpoint(path)", "load_from_checkpoint"),
        ("from omegaconf import OmegaConf\nOmegaConf.load(path)", "OmegaConf.load"),
        ("from PIL import Image\nImage.open(path)", "Image.open"),
    ],
)
def test_every_rule_finds_its_fault(source: str, found: str) -> None:
    assert list(complaints(source)) == [found]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_sources(path: Path) -> None:
    allowed = ALLOWED.get(path.relative_to(ROOT).as_posix(), set())
    assert [found for found in complaints(path.read_text()) if found not in allowed] == []
