"""A run's curve: its losses, IoU and Near-MAE by epoch."""

import csv
import io
import math
from pathlib import Path
from typing import TYPE_CHECKING

from scenegen.errors import DatasetError
from scenegen.files import read_bounded
from scenegen.limits import MOST_EPOCHS, MOST_LINE_BYTES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PANELS = {"loss": ("train_loss", "val_loss"), "IoU": ("val_iou",), "Near-MAE, m": ("val_near_mae",)}


def read_rows(path: Path) -> list[dict[str, float]]:
    """The figures of a run's epochs, from its ``metrics.csv``. Raises DatasetError for a file that
    holds none."""
    try:
        text = read_bounded(path, MOST_EPOCHS * MOST_LINE_BYTES).decode()
        rows = [
            {name: float(value) for name, value in row.items()}
            for row in csv.DictReader(io.StringIO(text))
        ]
    except (ValueError, TypeError, AttributeError, csv.Error):
        rows = []
    needed = {"epoch", *(name for names in PANELS.values() for name in names)}
    if not rows or not all(
        needed <= row.keys() and all(map(math.isfinite, row.values())) for row in rows
    ):
        raise DatasetError(
            f"{path}: holds no figures of epochs; expected what `scenegen train` writes"
        )
    return rows


def draw(rows: list[dict[str, float]], *, title: str = "") -> "Figure":
    """A panel each for losses, IoU and Near-MAE. Raises ImportError where matplotlib is not
    installed."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3), layout="constrained")
    if title:
        figure.suptitle(title, fontsize=11)
    for axes, (name, columns) in zip(figure.subplots(1, len(PANELS)), PANELS.items(), strict=True):
        for column in columns:
            axes.plot(
                [row["epoch"] for row in rows],
                [row[column] for row in rows],
                marker=".",
                label=column,
            )
        axes.set(title=name, xlabel="epoch")
        axes.grid(alpha=0.3)
        axes.legend()
    return figure
