"""Who imports whom, read from the source: imports inside functions count as well."""

import ast
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

from tests.commands import ROOT

# What a package of vg2gt may import in addition to itself and the leaves, which import no other package.
LEAVES = {"types", "config", "memory", "profiling"}
BASICS = "geometry io kernels"
MAY_IMPORT = {
    "geometry": "",
    "kernels": "",
    "io": "geometry",
    **dict.fromkeys(("data", "rendering", "method", "losses", "metrics", "visibility"), BASICS),
    "uncertainty": f"visibility {BASICS}",
    "model": f"visibility method backends {BASICS}",
    "baselines": f"visibility model method backends {BASICS}",
    "runs": f"visibility uncertainty baselines model method rendering data backends {BASICS}",
    "viewer": f"rendering {BASICS}",
    "refinement": f"visibility losses metrics rendering method {BASICS}",
    "evaluation": f"visibility uncertainty refinement runs model rendering metrics data {BASICS}",
    "monitor": "",
    "inputs": f"monitor model data {BASICS}",
    "reconstruction": "monitor inputs visibility uncertainty refinement runs model method rendering data " + BASICS,
    "outputs": f"monitor inputs reconstruction visibility rendering viewer {BASICS}",
    "api": "monitor inputs reconstruction outputs runs",
    "training": f"evaluation runs model method losses rendering data backends {BASICS}",
    "studies": f"training evaluation runs {BASICS}",
    "cli": "api studies training evaluation monitor inputs reconstruction outputs refinement viewer runs rendering "
    f"data backends {BASICS}",
}
UPWARDS = {"vg2gt.reconstruction.scene -> vg2gt.outputs.outputs"}  # a scene saves itself
OF_BACKENDS = ("vg2gt.types", "vg2gt.geometry", "vg2gt.io.tensors", "vg2gt.io.files", "vg2gt.kernels.compiled")


def modules() -> dict[str, Path]:
    found = {}
    for path in [*ROOT.glob("vg2gt/**/*.py"), *ROOT.glob("backends/**/*.py")]:
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        found[name.removesuffix(".__init__")] = path
    return found


MODULES = modules()


class WithoutTypeChecking(ast.NodeTransformer):
    """Takes away what is imported for type checkers only: it runs never."""

    def visit_If(self, node: ast.If) -> ast.AST | None:
        return None if ast.unparse(node.test) == "TYPE_CHECKING" else self.generic_visit(node)


def imports(module: str, when_run: bool) -> set[str]:
    """The modules of this project that one imports; a name of a package that is no module is its ``__init__``'s."""
    names: set[str] = set()
    tree = ast.parse(MODULES[module].read_text())
    for node in ast.walk(WithoutTypeChecking().visit(tree) if when_run else tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative import"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    found = {name if name in MODULES else name.rpartition(".")[0] for name in names}
    return {name for name in found if name in MODULES and name != module}


def room(module: str) -> str:
    """``geometry`` of ``vg2gt.geometry.cameras``; ``backends`` of all in there."""
    first, _, rest = module.partition(".")
    return rest.partition(".")[0] if first == "vg2gt" else first


GRAPH = {module: imports(module, when_run=False) for module in MODULES}


def test_there_is_no_circle() -> None:
    TopologicalSorter({module: imports(module, when_run=True) for module in MODULES}).prepare()


def test_imports_go_one_way() -> None:
    TopologicalSorter({name: names.split() for name, names in MAY_IMPORT.items()}).prepare()  # the table has no circle
    wrong = []
    for module, imported in GRAPH.items():
        here = room(module)
        if here in ("", "backends"):  # vg2gt itself imports on demand what it offers
            continue
        allowed = set() if here in LEAVES else {here, *LEAVES, *MAY_IMPORT[here].split()}
        wrong += [f"{module} -> {other}" for other in imported if room(other) not in allowed and other != "vg2gt"]
    assert set(wrong) == UPWARDS


def test_backends_need_little_of_the_project() -> None:
    wrong = [
        f"{module} -> {other}"
        for module, imported in GRAPH.items()
        if room(module) == "backends"
        for other in imported
        if room(other) != "backends" and not other.startswith(OF_BACKENDS)
    ]
    assert not wrong


def test_nothing_needs_recipes_or_examples() -> None:
    """They are not in the wheel."""
    needed = ("import recipes", "from recipes", "import examples", "from examples", "TUM(")
    assert not [name for name, path in MODULES.items() if any(word in path.read_text() for word in needed)]


def test_data_and_reconstruction_are_imported_without_lightning() -> None:
    code = """
import sys, vg2gt.data, vg2gt.data.sources
assert not {"lightning", "hydra"} & set(sys.modules)
import vg2gt.reconstruction.scene, vg2gt.outputs.outputs
assert "lightning" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True)
