"""The log that the training curves are read from; a killed process or a full disk leaves whole rows in it."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lightning.fabric.utilities.rank_zero import rank_zero_only
from lightning.pytorch.loggers import CSVLogger

from vg2gt.io.files import write_text


class WholeRowsLogger(CSVLogger):
    """Writes ``<save_dir>/<name>/version_<n>/metrics.csv``, where n is new for every process.

    Differs from Lightning's logger in how it writes: rows are appended whole, and the file is replaced by a rename when
    a new column appears.

    Args:
        save_dir: the run's folder.
        name: the folder of all versions in it.
    """

    def __init__(self, save_dir: str, name: str = "logs") -> None:
        super().__init__(save_dir, name)
        self._columns: list[str] = []
        self._rows: list[dict[str, Any]] = []

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:  # pyright: ignore
        """Takes a row; it is written by :meth:`save`, which Lightning calls after every row."""
        self._rows.append({**metrics, "step": 0 if step is None else step})

    @rank_zero_only
    def save(self) -> None:
        """Writes the rows taken.

        Raises:
            OSError: if the disk is full, naming the file; the rows written before are still there.
        """
        if not self._rows:
            return
        path = Path(self.log_dir) / "metrics.csv"
        columns = sorted({*self._columns, *(name for row in self._rows for name in row)})
        if columns == self._columns:
            _append(path, _lines(columns, self._rows))
        else:
            written = list(csv.DictReader(path.open(newline=""))) if self._columns else []
            header = ",".join(columns) + "\n"
            write_text(path, header + _lines(columns, [*written, *self._rows]))
            self._columns = columns
        self._rows = []


def _lines(columns: list[str], rows: list[dict[str, Any]]) -> str:
    buffer = io.StringIO()
    csv.DictWriter(buffer, columns, lineterminator="\n").writerows(rows)
    return buffer.getvalue()


def _append(path: Path, text: str) -> None:
    with open(path, "ab", buffering=0) as file:
        end = file.tell()
        content = memoryview(text.encode())
        try:
            while content:  # a write may be cut short before it fails
                content = content[file.write(content) :]
        except OSError as error:
            file.truncate(end)
            raise OSError(error.errno, f"{path} could not be written: {error.strerror or error}") from error
