"""Training curves: ``vg2gt curves outputs/quickstart [outputs/other ...] [--out FILE]`` (extra: eval)."""

from __future__ import annotations

import csv
import math
from pathlib import Path

PANELS = ("loss", "train/color_l1", "train/depth_gt", "train/depth_reg", "train/normal", "train/grad_norm")
SMOOTHING = 0.05  # share of the run that the moving average looks at


def read_curves(run: str | Path) -> dict[str, dict[int, float]]:
    """Reads what a run logged, resumed parts included.

    Args:
        run: the run's folder, ``outputs/<name>``.

    Returns:
        ``{metric: {step: value}}``, steps ascending; where a resumed run repeated steps, the later part counts.

    Raises:
        FileNotFoundError: if the run has no log.
        ValueError: if the log has no values.
    """
    files = sorted(Path(run).glob("logs/version_*/metrics.csv"), key=lambda path: int(path.parent.name.split("_")[1]))
    if not files:
        raise FileNotFoundError(
            f"no logs/version_*/metrics.csv in {run}: name a run's folder that logs with logger=csv"
        )
    curves: dict[str, dict[int, float]] = {}
    for path in files:
        # A row that a killed process did not finish has no line break, and is logged again by the one that goes on.
        whole = path.read_text().rpartition("\n")[0]
        for row in csv.DictReader(whole.splitlines()):
            step = int(row["step"])
            for name, text in row.items():
                if name not in ("step", "epoch") and text:
                    curves.setdefault(name, {})[step] = float(text)
    if not curves:
        raise ValueError(f"{files[-1]} holds no values yet")
    return {name: dict(sorted(values.items())) for name, values in curves.items()}


def moving_average(values: list[float], window: int) -> list[float]:
    """Means over the last ``window`` values (fewer at the beginning), passing over what is not finite."""
    averages = []
    for end in range(1, len(values) + 1):
        finite = [value for value in values[max(0, end - window) : end] if math.isfinite(value)]
        averages.append(sum(finite) / len(finite) if finite else math.nan)
    return averages


def labels(runs: list[Path]) -> list[str]:
    """Shortest ends of the paths that tell the runs apart, such as ``seed-0/full`` and ``seed-1/full``."""
    parts = [run.resolve().parts for run in dict.fromkeys(runs)]
    length = 1
    while len({part[-length:] for part in parts}) < len({*parts}):
        length += 1
    return ["/".join(run.resolve().parts[-length:]) for run in runs]


def plot_curves(runs: list[Path], out: Path) -> Path:
    """Writes one panel per quantity and one line per run: every logged value pale, the moving average strong.

    Raises:
        ImportError: if matplotlib is not installed.
        ValueError: if no run has logged a training step.
    """
    try:
        from matplotlib import pyplot  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError("curves need matplotlib: pip install 'vg2gt[eval]'") from error
    curves = {label: read_curves(run) for label, run in zip(labels(runs), runs, strict=True)}
    shown = [name for name in PANELS if any(name in logged for logged in curves.values())]
    if not shown:
        raise ValueError(f"no training was logged in {', '.join(map(str, runs))}: none of {', '.join(PANELS)}")
    columns = min(3, len(shown))
    rows = math.ceil(len(shown) / columns)
    figure, panels = pyplot.subplots(rows, columns, figsize=(4 * columns, 2.8 * rows), squeeze=False)
    for panel, name in zip(panels.flat, shown, strict=False):
        for number, (run, logged) in enumerate(curves.items()):
            values = logged.get(name, {})
            steps, color = list(values), f"C{number}"
            smooth = moving_average(list(values.values()), max(1, round(SMOOTHING * len(values))))
            panel.plot(steps, list(values.values()), color=color, alpha=0.25)
            panel.plot(steps, smooth, color=color, label=run)
        panel.set(title=name.removeprefix("train/"), xlabel="step")
    for panel in panels.flat[len(shown) :]:
        panel.axis("off")
    panels.flat[0].legend(fontsize=8)
    figure.tight_layout()
    out.parent.mkdir(parents=True, exist_ok=True)
    temporary = out.with_name(f".{out.name}.tmp.png")
    figure.savefig(temporary, dpi=110)
    pyplot.close(figure)
    temporary.replace(out)
    return out
