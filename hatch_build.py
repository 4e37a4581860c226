"""Writes what a wheel is built from (``git describe``) into it, as ``vg2gt/SOURCE``; without git, nothing."""

import subprocess
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class SourceHook(BuildHookInterface):
    """The hook ``custom`` of pyproject.toml."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Adds the file; a source distribution keeps the one it was unpacked with."""
        kept = Path(self.root, "vg2gt", "SOURCE")
        if version == "editable" or kept.is_file():
            return
        command = ["git", "-C", self.root, "describe", "--always", "--dirty", "--tags"]
        try:
            text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        except (OSError, subprocess.CalledProcessError):
            return
        self.made = Path(self.directory, "SOURCE")
        self.made.parent.mkdir(parents=True, exist_ok=True)
        self.made.write_text(text)
        build_data["force_include"][str(self.made)] = "vg2gt/SOURCE"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Removes the file that was added."""
        if hasattr(self, "made"):
            self.made.unlink(missing_ok=True)
