"""Where the configuration groups are: inside the installed package, or beside it in a checkout."""

from pathlib import Path
from typing import Any

_PACKAGE = Path(__file__).resolve().parent


def config_dir() -> str:
    """Returns the absolute path of the configuration folder.

    Raises:
        FileNotFoundError: if neither the package nor the checkout holds it.
    """
    for folder in (_PACKAGE / "configs", _PACKAGE.parent / "configs"):
        if (folder / "train.yaml").is_file():
            return str(folder)
    raise FileNotFoundError(f"no configuration folder with train.yaml in or beside {_PACKAGE}; reinstall vg2gt")


def flatten(node: Any, prefix: str = "") -> dict[str, Any]:
    """Names the leaves of nested dictionaries by dotted keys."""
    if not isinstance(node, dict):
        return {prefix: node}
    return {
        key: value
        for name, child in node.items()
        for key, value in flatten(child, f"{prefix}.{name}".strip(".")).items()
    }
