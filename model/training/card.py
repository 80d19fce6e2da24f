"""What a run leaves for people: its card and its curve."""

import csv
import io
import math
import re
from pathlib import Path
from typing import Any

from scenegen.errors import DatasetError
from scenegen.files import Json, read_bounded
from scenegen.limits import MOST_EPOCHS, MOST_LINE_BYTES
from scenegen.model.config import VARIANTS
from scenegen.model.evaluation.metrics import METRICS

Scalars = dict[str, float]
"""Figures of a step or an epoch, by name."""
PANELS = {"loss": ("train_loss", "val_loss"), "IoU": ("val_iou",), "Near-MAE, m": ("val_near_mae",)}


def read_rows(path: Path) -> list[Scalars]:
    """The figures of a run's epochs, from its ``metrics.csv``. Raises DatasetError for a file that
    holds none."""
    try:
        text = read_bounded(path, MOST_EPOCHS * MOST_LINE_BYTES).decode()
        rows = [
            {name: float(value) for name, value in row.items() if value}  # some begin later
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


def draw(rows: list[Scalars], *, title: str = "") -> Any:
    """A figure of matplotlib, with a panel each for losses, IoU and Near-MAE. Raises ImportError
    where that is not installed."""
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


FULL_EPOCHS = 100
"""Epochs of the full protocol at most; it ends when validation no longer improves."""
GIVES = {"occupancy": "the probability of occupancy", "tudf": "the truncated distance, metres"}
"""What a network predicts, by task."""


def card(name: str, about: Json) -> str:
    """The card of a network, as Markdown, from what its file's header says `about` it."""
    settings, figures, command = about["settings"], about["figures"], about["command"]
    network = settings["network"]
    known = VARIANTS.get(network["variant"])  # of a user's own nobody says what it gives
    tasks = [what for task, what in GIVES.items() if known and task in known.tasks]
    gives = " and gives " * bool(tasks) + " and ".join(tasks)
    occupancy_first = sorted(METRICS.items(), key=lambda item: item[1].needs != "occupancy")
    labels = {"val_loss": "loss"} | {
        f"val_{name}": metric.label for name, metric in occupancy_first
    }
    shown = [key for key in labels if key in figures]
    shares = [f" (weight {share})" for share in settings.get("shares", ())] or [""] * len(
        settings["kinds"]
    )
    parts = zip(settings["kinds"], settings["datasets"], shares, strict=True)
    data = ", ".join(f"{kind} {digest[:16]}…{share}" for kind, digest, share in parts)
    samples, epochs, full = settings["samples"], settings["epochs"], ""
    amount = (
        "samples of which each was seen once: stream"
        if samples is None
        else f"{samples} samples: datasets"
    )
    length = f"{figures['maps']:.0f} maps seen"
    if epochs < FULL_EPOCHS and settings.get("maps") is None:
        whole = re.sub(f" --epochs[ =]{epochs}(?![0-9])", "", command)
        full = f"""This is not the full protocol, which trains for up to {FULL_EPOCHS} epochs and \
stops when validation has not improved for {settings["patience"]}: `{whole}`.

"""
    versions = ", ".join(f"{one} {version}" for one, version in about["versions"].items())
    return f"""# {name}

A completion network of scenegen: variant `{network["variant"]}`, width {network["width"]}, \
stem stride {network["stem_stride"]}. It takes {", ".join(network["inputs"])} of one map{gives}.

| trained | |
|---|---|
| on | {amount} {data} |
| by | `{command}` |
| for | {length}, batch {settings["batch"]}, \
{"Muon" if settings.get("optimizer") == "muon" else "AdamW"} at {settings["lr"]:g}, \
seed {settings["seed"]}, {settings["precision"]} |
| on hardware | {about["device"]} |
| with | commit {about["commit"]}; {versions} |

Means over the validation split at the paper's thresholds, whole maps:

| {" | ".join(labels[key] for key in shown)} |
{"|---" * len(shown)}|
| {" | ".join(f"{figures[key]:.3f}" for key in shown)} |

{full}Limits: the network knows the worlds, the sensor and the grid that it was trained on, and \
nothing else. It takes one scan and no history. Where no ray came near, it repeats what was usual \
in training. {_sure(about)}
"""


def _sure(about: Json) -> str:
    """What its probabilities are worth."""
    loss = about["settings"]["loss"]
    learned = f"with occupied voxels {loss['occupied_weight']:g} times as heavy as free ones"
    learned += " and by the Lovász hinge of the IoU, too" if loss.get("lovasz") else ""
    held = about.get("calibration")
    if held is None:
        return f"Its probabilities are not calibrated, but as they were learned, {learned}."
    temperature = "" if held["temperature"] is None else f", temperature {held['temperature']:.3f}"
    return (
        f"`occupancy_probability` is as it was learned, {learned}; `probability`, bounds of "
        f"distance and the risk of paths are calibrated, on {held['worlds']} worlds of "
        f"validation{temperature}, down to a risk of {min(held['risks']):g}."
    )
