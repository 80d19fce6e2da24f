"""Pages of a run for people: the card of its network, and its curves."""

import csv
import io
import math
import re
from itertools import zip_longest
from pathlib import Path
from typing import Any

from scenegen.base.errors import DatasetError, printable
from scenegen.base.files import Json
from scenegen.base.limits import MAX_EPOCHS, MAX_LINE_BYTES
from scenegen.base.reading import read_bounded
from scenegen.model.bench.metrics import METRICS
from scenegen.model.config import VARIANTS, target_name
from scenegen.view.canvas import SCREEN, Paper

Scalars = dict[str, float]
"""Figures of a step or an epoch, by name."""
PANELS = {
    "loss": ("train_loss", "val_loss"),
    "IoU": ("val_iou", "val_best_iou"),
    "Near-MAE, m": ("val_near_mae",),
}
"""Columns that each panel shows, by its title."""
LATER = "val_best_iou"
"""A column that runs of earlier versions lack; their rows are read all the same."""


def read_rows(path: Path) -> list[Scalars]:
    """Read the figures of a run's epochs.

    Args:
        path: A run's ``metrics.csv``.

    Returns:
        Figures by name, for each epoch.

    Raises:
        DatasetError: if the file is missing or damaged, or has no epochs.
    """
    try:
        text = read_bounded(path, MAX_EPOCHS * MAX_LINE_BYTES).decode()
        rows = [
            {name: float(value) for name, value in row.items() if value}
            # an empty cell is a column that began in a later epoch
            for row in csv.DictReader(io.StringIO(text))
        ]
    except (ValueError, TypeError, AttributeError, csv.Error):
        rows = []
    needed = {"epoch", *(name for names in PANELS.values() for name in names)} - {LATER}
    if not rows or not all(
        needed <= row.keys() and all(map(math.isfinite, row.values())) for row in rows
    ):
        raise DatasetError(
            f"{path}: holds no figures of epochs; expected what `scenegen train` writes"
        )
    return rows


def draw(rows: list[Scalars], *, title: str = "", paper: Paper = SCREEN) -> Any:
    """Draw losses, IoU and Near-MAE by epoch, in a panel each.

    Args:
        rows: Figures of each epoch.
        title: Title above the panels, which print does not have.
        paper: Size of the picture. Panels stand one above the other if it is narrow.

    Returns:
        A `matplotlib.figure.Figure`.

    Raises:
        ImportError: if matplotlib is not installed.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    from scenegen.view.stills import style

    wide = paper.width or 9.0
    shape = (1, len(PANELS)) if wide > 5 else (len(PANELS), 1)
    with rc_context(style(paper)):
        figure = Figure(figsize=(wide, wide / 3 if wide > 5 else 1.6 * wide), layout="constrained")
        figure.suptitle("" if paper.width else printable(title))
        for axes, (name, columns) in zip(figure.subplots(*shape), PANELS.items(), strict=True):
            for column in columns:
                axes.plot(
                    [row["epoch"] for row in rows],
                    [row.get(column, math.nan) for row in rows],
                    marker=".",
                    label=column,
                )
            axes.set(title=name, xlabel="epoch")
            axes.tick_params(labelsize=paper.points)
            axes.grid(alpha=0.3)
            axes.legend()
    return figure


def draw_run(folder: Path, paper: Paper = SCREEN) -> Any:
    """Draw the curves of a run.

    Args:
        folder: The run's folder.
        paper: Size of the picture.

    Returns:
        See `draw`.

    Raises:
        DatasetError: if the folder has no figures.
        ImportError: if matplotlib is not installed.
    """
    return draw(read_rows(folder / "metrics.csv"), title=folder.resolve().name, paper=paper)


FULL_EPOCHS = 100
"""Maximum of epochs in the full protocol, which ends earlier if validation stops improving."""
OUTPUTS = {"occupancy": "the probability of occupancy", "tudf": "the truncated distance, metres"}
"""Outputs of a network in words, by task."""


def card(name: str, metadata: Json) -> str:
    """Write the card of a network.

    Args:
        name: Name of the network.
        metadata: Metadata of the network's file, with `settings`, `figures`, and its origin.

    Returns:
        Markdown.
    """
    settings, figures, command = metadata["settings"], metadata["figures"], metadata["command"]
    network, samples = settings["network"], settings["samples"]
    variant = VARIANTS.get(network["variant"])  # None for a user's own, whose tasks are not stored
    outputs = [output for task, output in OUTPUTS.items() if variant and task in variant.tasks]
    outputs += [target_name(name) for name in network.get("targets", ())]
    gives = f" and gives {' and '.join(outputs)}" if outputs else ""
    # only runs with weights have shares; then one for each dataset
    shares = [f" (weight {share})" for share in settings.get("shares", ())]
    sources = zip_longest(settings["kinds"], settings["datasets"], shares, fillvalue="")
    data = ", ".join(f"{kind} {digest[:16]}…{share}" for kind, digest, share in sources)
    amount = f"{samples} samples: datasets"
    if samples is None:  # `describe` counts the samples of datasets only
        amount = "samples of which each was seen once: stream"
    versions = ", ".join(f"{name} {version}" for name, version in metadata["versions"].items())
    occupancy_first = sorted(METRICS.items(), key=lambda item: item[1].needs != "occupancy")
    labels = {"loss": "loss"} | {name: metric.label for name, metric in occupancy_first}
    columns = {
        label: figures[f"val_{key}"] for key, label in labels.items() if f"val_{key}" in figures
    }
    return f"""# {name}

A completion network of scenegen: variant `{network["variant"]}`, width {network["width"]}. \
It takes {", ".join(network["inputs"])} of one map{gives}.

| trained | |
|---|---|
| on | {amount} {data} |
| by | `{command}` |
| for | {figures["maps"]:.0f} maps seen, batch {settings["batch"]}, \
{"Muon" if settings.get("optimizer") == "muon" else "AdamW"} at {settings["lr"]:g}, \
seed {settings["seed"]}, {settings["precision"]} |
| on hardware | {metadata["device"]} |
| with | commit {metadata["commit"]}; {versions} |

Means over the validation split at the paper's thresholds, whole maps:

| {" | ".join(columns)} |
{"|---" * len(columns)}|
| {" | ".join(f"{value:.3f}" for value in columns.values())} |

{_full_protocol(settings, command)}\
Limits: the network knows the worlds, the sensor and the grid that it was trained on, and \
nothing else. It takes one scan and no history. Where no ray came near, it repeats what was usual \
in training. {_probabilities(metadata)}
"""


def _full_protocol(settings: Json, command: str) -> str:
    """Say that a run is shorter than the full protocol, and how to run that; "" if it is not."""
    epochs = settings["epochs"]
    if epochs >= FULL_EPOCHS or settings.get("maps") is not None:
        return ""
    # 100 epochs are the default, so the full command is this one without the option
    full = re.sub(f" --epochs[ =]{epochs}(?![0-9])", "", command)
    return f"""This is not the full protocol, which trains for up to {FULL_EPOCHS} epochs and \
stops when validation has not improved for {settings["patience"]}: `{full}`.

"""


def _probabilities(metadata: Json) -> str:
    """Say whether the probabilities are calibrated, and by which loss they were learned."""
    loss = metadata["settings"]["loss"]
    learned = f"with occupied voxels {loss['occupied_weight']:g} times as heavy as free ones"
    learned += " and by the Lovász hinge of the IoU, too" if loss.get("lovasz") else ""
    calibration = metadata.get("calibration")
    if calibration is None or calibration["temperature"] is None:
        return f"Its probabilities are not calibrated, but as they were learned, {learned}."
    return (
        f"`occupancy_probability` is as it was learned, {learned}; `probability` is calibrated on "
        f"{calibration['worlds']} worlds of validation, "
        f"temperature {calibration['temperature']:.3f}."
    )
