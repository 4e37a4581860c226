"""What README and docs say can be found and run: links, commands, options, files, tables, the site."""

import io
import re
import shlex
import shutil
import sys
from contextlib import redirect_stdout, suppress
from functools import cache
from itertools import pairwise
from pathlib import Path

import pytest

import vg2gt.cli
from tests.commands import ROOT
from tests.training_helpers import group_options
from vg2gt.cli.arguments import separate
from vg2gt.cli.commands import COMMANDS, DATA_COMMANDS
from vg2gt.config import compose, config_dir
from vg2gt.memory import RECONSTRUCTION

DOCS = sorted((ROOT / "docs").rglob("*.md"))
PAGES = [
    *sorted(ROOT.glob("*.md")),
    *DOCS,
    *sorted(ROOT.glob("*/README.md")),
    *sorted(ROOT.glob("recipes/*/README.md")),
]
HYDRA = {"train.py": "train", "train": "train", "evaluate": "evaluate", "calibrate": "calibrate", "ablate": "ablate"}
SOURCES = ("vg2gt", "backends", "configs", "recipes", "examples", "benchmarks", "tests")


def named(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def slug(heading: str) -> str:
    """As GitHub and mkdocs name a heading's anchor."""
    plain = re.sub(r"\[(.*?)\]\(.*?\)|[`*]", r"\1", heading)
    return re.sub(r"\s+", "-", re.sub(r"[^\w\s-]", "", plain).strip().lower())


def without_code(text: str) -> str:
    return re.sub(r"```.*?```|`[^`\n]*`", "", text, flags=re.DOTALL)


def commands(page: Path) -> list[str]:
    """Lines of the page's code blocks and code in its tables that start one of our programs."""
    text = page.read_text()
    blocks = [line for block in re.findall(r"```\w*\n(.*?)```", text, re.DOTALL) for line in block.splitlines()]
    inline = re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    starts = ("vg2gt ", "python train.py", "srun python train.py", "python benchmarks/", "python -m recipes")
    return [line.split(" #")[0].strip() for line in [*blocks, *inline] if line.startswith(starts)]


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_relative_links_and_anchors_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", without_code(page.read_text())):
        if re.match(r"\w+:|\.\./\.\./actions/", target):  # of the web, and the badge's on the hosting site
            continue
        path, _, anchor = target.partition("#")
        place = (page.parent / path).resolve() if path else page
        assert place.exists(), f"{named(page)} links to {target}"
        if anchor:
            headings = re.findall(r"^#+ (.+)$", place.read_text(), re.MULTILINE)
            assert anchor in {slug(heading) for heading in headings}, f"{named(page)} links to {target}"


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_files_that_are_named_exist(page: Path) -> None:
    for path in re.findall(
        r"`((?:docs|examples|backends|recipes|benchmarks|tests|vg2gt|configs)/[\w./-]+)`", page.read_text()
    ):
        assert (ROOT / path).exists(), f"{named(page)} names {path}"
    for path in re.findall(r"--8<-- \"(.+?)\"", page.read_text()):
        assert (ROOT / path).is_file(), f"{named(page)} shows {path}"


# tests/test_paper_tables.py composes those of the page that it is about
@pytest.mark.parametrize("page", [p for p in PAGES if commands(p) and p.name != "paper-tables.md"], ids=named)
def test_commands_and_their_options_exist(page: Path) -> None:
    for line in commands(page):
        words = shlex.split(line)
        if words[1].isupper() or "NAME" in words[1]:
            continue
        if words[:2] == ["srun", "python"]:
            words = words[1:]
        if words[0] == "python" and words[1].startswith("benchmarks/"):
            assert (ROOT / words[1]).is_file(), line
            continue
        program = words[1] if words[0] in ("vg2gt", "python") else ""
        if words[0] == "vg2gt":
            assert program in COMMANDS, line
            assert program != "data" or words[2] in DATA_COMMANDS, line
        if program in HYDRA:
            if not {"-m", "-h"} & set(words):
                composes(HYDRA[program], words[2:], line)
        elif words[0] == "vg2gt":
            command = words[1:3] if program == "data" else words[1:2]
            overrides = separate(words[1 + len(command) :])[1]
            flags = {word for word in words if word.startswith("--")} - {"--help"}
            assert flags <= set(re.findall(r"--[\w-]+", help_of(*command))), line
            composes(
                "evaluate" if command[-1] == "views" else "train",
                [f"+{o}" if o.startswith(("refine.", "refine=")) else o for o in overrides],
                line,
            )


@cache
def help_of(*command: str) -> str:
    """What ``vg2gt COMMAND --help`` prints."""
    shown = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(shown), suppress(SystemExit):
        patch.setattr(sys, "argv", ["vg2gt", *command, "--help"])
        vg2gt.cli.main()
    return shown.getvalue()


def composes(config: str, words: list[str], line: str) -> None:
    """Hydra takes the line's overrides; capital words stand for what a reader has."""
    folders = [words[i + 1] for i, word in enumerate(words) if word == "--config-dir"]
    overrides = [word for word in words if "=" in word and not word.startswith("-")]
    path = [f"hydra.searchpath=[{ROOT / folder}]" for folder in folders]
    try:
        composed_once(config, *path, *overrides)
    except Exception as error:
        raise AssertionError(f"{line}: {error}") from error


@cache
def composed_once(config: str, *overrides: str) -> None:
    """Composes a configuration; commands that occur on several pages are composed once."""
    compose(config, "++output_dir=unused", *overrides)


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_options_of_groups_exist(page: Path) -> None:
    text = page.read_text()
    examples = {(path.parent.name, path.stem) for path in ROOT.glob("examples/**/configs/*/*.yaml")}
    for group in (path.name for path in Path(config_dir()).iterdir() if path.is_dir() and path.name != "hydra"):
        for option in re.findall(rf"(?<![\w.=+/-]){group}=([a-z]\w*)(?![\w.*/])", text):
            found = option in group_options(group) or (group, option) in examples
            assert found or option == "null", f"{named(page)}: {group}={option}"


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_rows_of_tables_have_as_many_cells_as_their_header(page: Path) -> None:
    lines = without_code(page.read_text(encoding="utf-8")).splitlines()
    for before, line in pairwise(lines):
        if before.startswith("|") and line.startswith("|"):
            assert line.count("|") == before.count("|"), line


def test_code_names_pages_that_exist() -> None:
    for path in (path for source in SOURCES for path in (ROOT / source).rglob("*") if path.suffix in (".py", ".yaml")):
        for page in re.findall(r"docs/[\w/-]+\.md", path.read_text()):
            assert (ROOT / page).is_file(), f"{named(path)} names {page}"


def test_every_figure_is_shown() -> None:
    shown = "".join(page.read_text() for page in PAGES)
    for figure in (ROOT / "docs" / "figures").iterdir():
        assert f"figures/{figure.name}" in shown, figure.name


PROGRAMS = ("VG²GT", "OpenSplat")


def rows(path: Path) -> set[tuple[str, ...]]:
    lines = [line for line in path.read_text().splitlines() if line.startswith("|")]
    return {tuple(cell.strip() for cell in line.strip("|").split("|")) for line in lines}


def test_figures_of_photos_are_the_newest_measured() -> None:
    """The rows of README and docs/results.md are those that benchmarks/photos.py wrote; copy them when they change."""
    newest = rows(max((ROOT / "benchmarks" / "results").glob("*-photos.md")))
    # the pages name settings and weights in their text, and the README has a column for each figure
    measured = {(*row[:2], *" ".join(row[4:]).split()) for row in newest}
    for page, least in (("docs/results.md", 10), ("README.md", 4)):
        shown = {(*row[:2], *" ".join(row[2:]).split()) for row in rows(ROOT / page) if row[1] in PROGRAMS}
        assert len(shown) >= least
        assert shown <= measured


def test_the_readme_links_no_page_that_would_be_shown_as_source() -> None:
    assert not re.findall(r"\]\(([^)]+\.html)\)", (ROOT / "README.md").read_text())


def test_advice_names_options_that_exist() -> None:
    """What is said when memory is full."""
    flags = re.findall(r"--[a-z-]+", RECONSTRUCTION)
    assert flags
    assert set(flags) <= set(re.findall(r"--[a-z-]+", help_of("reconstruct")))


def test_the_site_lists_every_page() -> None:
    listed = re.findall(r": ([\w/-]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    assert {ROOT / "docs" / page for page in listed} == set(DOCS)


def test_the_site_builds(tmp_path: Path) -> None:
    pytest.importorskip("material", reason='needs pip install -e ".[docs]"')
    from mkdocs.commands.build import build  # pyright: ignore[reportMissingImports]
    from mkdocs.config import load_config  # pyright: ignore[reportMissingImports]

    build(load_config(str(ROOT / "mkdocs.yml"), strict=True, site_dir=str(tmp_path / "site")))
    assert (tmp_path / "site" / "results" / "index.html").is_file()
    shutil.rmtree(tmp_path / "site")
