"""A network's card: what it is, what it was trained on, what it is worth, and what it is not good for."""

import re
from collections.abc import Mapping
from typing import Any

FULL_EPOCHS = 100
"""Of the full protocol, which ends when validation no longer improves."""
SHOWN = {
    "val_loss": "loss",
    "val_iou": "IoU",
    "val_f1": "F1",
    "val_precision": "precision",
    "val_recall": "recall",
    "val_rmse": "RMSE, m",
    "val_mae": "MAE, m",
    "val_near_rmse": "Near-RMSE, m",
    "val_near_mae": "Near-MAE, m",
    "val_bias": "bias, m",
}


def card(name: str, about: Mapping[str, Any]) -> str:
    """The card of a network, as Markdown, from what its file's header says `about` it."""
    settings, figures = about["settings"], about["figures"]
    network = settings["network"]
    data = ", ".join(
        f"{kind} {digest[:16]}…" for kind, digest in zip(settings["kinds"], settings["datasets"], strict=True)
    )
    versions = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
    lines = [
        f"# {name}",
        "",
        f"A completion network of scenegen: variant `{network['variant']}`, width {network['width']}, stem stride "
        f"{network['stem_stride']}. It takes the observed voxels of one scan and gives "
        + " and ".join(_gives(network["variant"]))
        + ".",
        "",
        "| trained | |",
        "|---|---|",
        f"| on | {settings['samples']} samples: datasets {data} |",
        f"| by | `{about['command']}` |",
        f"| for | {figures['epoch']:.0f} epochs to the best of {settings['epochs']} at most, "
        f"batch {settings['batch']}, AdamW at {settings['lr']:g}, seed {settings['seed']}, {settings['precision']} |",
        f"| on hardware | {about['device']} |",
        f"| with | commit {about['commit']}; {versions} |",
        "",
        "Means over the validation split at the paper's thresholds, whole maps:",
        "",
        "| " + " | ".join(SHOWN.values()) + " |",
        "|---" * len(SHOWN) + "|",
        "| " + " | ".join(f"{figures[key]:.3f}" for key in SHOWN) + " |",
        "",
    ]
    if settings["epochs"] < FULL_EPOCHS:
        lines += [
            f"This is not the full protocol, which trains for up to {FULL_EPOCHS} epochs and stops when validation has "
            f"not improved for {settings['patience']}: `{_full(about['command'], settings['epochs'])}`.",
            "",
        ]
    lines += [
        "Limits: it knows the worlds, the sensor and the grid that it was trained on, and nothing else; it takes one "
        "scan and no history; what no ray came near it fills with what was usual in training; probabilities are not "
        "calibrated (occupied voxels weighed "
        f"{settings['loss']['occupied_weight']:g} times as much as free ones).",
    ]
    return "\n".join(lines) + "\n"


def _gives(variant: str) -> list[str]:
    gives = {"occ": ["the probability of occupancy"], "tudf": ["the truncated distance, metres"]}
    return gives.get(variant, gives["occ"] + gives["tudf"])


def _full(command: str, epochs: int) -> str:
    return re.sub(rf" --epochs[ =]{epochs}\b", "", command)
