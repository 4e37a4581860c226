"""``vg2gt export``, or ``python -m backends.export``: a frozen network as an ONNX bundle."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

from omegaconf import MISSING

from vg2gt.cli.arguments import key_value_command, read_options
from vg2gt.cli.commands import COMMANDS
from vg2gt.config import compose


@dataclass
class ExportOptions:
    """The command's own options."""

    out: str = MISSING
    backend: str = MISSING


@key_value_command(COMMANDS["export"])
def main(arguments: list[str]) -> None:
    """Writes a frozen network as an ONNX bundle with free numbers of scenes, views, rows and columns.

    vg2gt export backend=NAME out=FOLDER [backend.key=value ...]

      backend=NAME      of configs/backend: VGGT or a relative DA3 network
      out=FOLDER        a new folder
    """
    from hydra.utils import instantiate

    from backends.export import export

    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    options, overrides = read_options(ExportOptions, arguments)
    config = compose(None, f"+backend={options.backend}", *overrides)
    description = export(instantiate(config.backend), Path(options.out).expanduser())
    found = f"{options.out}: {description.name}, licence: {description.licence}"
    differences = ", ".join(f"{part} {value:.1e}" for part, value in description.max_difference.items())
    print(f"{found}; largest difference to torch: {differences}")


if __name__ == "__main__":
    main()
