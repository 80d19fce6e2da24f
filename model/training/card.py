"""A network's card: what it is, what it was trained on, what it is worth, and what it is not good for."""

import re
from collections.abc import Mapping
from typing import Any

from scenegen.model.config import VARIANTS
from scenegen.model.evaluation.metrics import METRICS

FULL_EPOCHS = 100
"""Epochs of the full protocol at most; it ends when validation no longer improves."""
GIVES = {"occupancy": "the probability of occupancy", "tudf": "the truncated distance, metres"}
"""What a network predicts, by task."""


def card(name: str, about: Mapping[str, Any]) -> str:
    """The card of a network, as Markdown, from what its file's header says `about` it."""
    settings, figures = about["settings"], about["figures"]
    network = {"inputs": ["observed"]} | settings["network"]  # which networks of earlier commits do not name
    occupancy_first = sorted(METRICS.items(), key=lambda item: item[1].needs != "occupancy")
    shown = {"val_loss": "loss"} | {f"val_{name}": metric.label for name, metric in occupancy_first}
    shown = {key: label for key, label in shown.items() if key in figures}
    shares = [f" (weight {share})" for share in settings.get("shares", ())] or [""] * len(settings["kinds"])
    data = ", ".join(
        f"{kind} {digest[:16]}…{share}"
        for kind, digest, share in zip(settings["kinds"], settings["datasets"], shares, strict=True)
    )
    versions = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
    lines = [
        f"# {name}",
        "",
        f"A completion network of scenegen: variant `{network['variant']}`, width {network['width']}, stem stride "
        f"{network['stem_stride']}. It takes {', '.join(network['inputs'])} of one map and gives "
        + " and ".join(GIVES[task] for task in GIVES if task in VARIANTS[network["variant"]].tasks)
        + ".",
        "",
        "| trained | |",
        "|---|---|",
        f"| on | {_amount(settings)} {data} |",
        f"| by | `{about['command']}` |",
        f"| for | {_length(settings, figures)}, "
        f"batch {settings['batch']}, AdamW at {settings['lr']:g}, seed {settings['seed']}, {settings['precision']} |",
        f"| on hardware | {about['device']} |",
        f"| with | commit {about['commit']}; {versions} |",
        "",
        "Means over the validation split at the paper's thresholds, whole maps:",
        "",
        "| " + " | ".join(shown.values()) + " |",
        "|---" * len(shown) + "|",
        "| " + " | ".join(f"{figures[key]:.3f}" for key in shown) + " |",
        "",
    ]
    if settings["epochs"] < FULL_EPOCHS and settings.get("maps") is None:
        full = re.sub(rf" --epochs[ =]{settings['epochs']}\b", "", about["command"])
        lines += [
            f"This is not the full protocol, which trains for up to {FULL_EPOCHS} epochs and stops when validation has "
            f"not improved for {settings['patience']}: `{full}`.",
            "",
        ]
    lines += [
        "Limits: the network knows the worlds, the sensor and the grid that it was trained on, and nothing else. It "
        "takes one scan and no history. Where no ray came near, it repeats what was usual in training. " + _sure(about),
    ]
    return "\n".join(lines) + "\n"


def _sure(about: Mapping[str, Any]) -> str:
    """What its probabilities are worth."""
    loss = about["settings"]["loss"]
    learned = f"with occupied voxels {loss['occupied_weight']:g} times as heavy as free ones"
    learned += " and by the Lovász hinge of the IoU, too" if loss.get("lovasz") else ""
    held = about.get("calibration")
    if held is None:
        return f"Its probabilities are not calibrated, but as they were learned, {learned}."
    temperature = "" if held["temperature"] is None else f", temperature {held['temperature']:.3f}"
    return (
        f"`occupancy_probability` is as it was learned, {learned}; `probability`, bounds of distance and the risk of "
        f"paths are calibrated, on {held['worlds']} worlds of validation{temperature}, down to a risk of "
        f"{min(held['risks']):g}."
    )


def _amount(settings: Mapping[str, Any]) -> str:
    """How many samples of what a network was trained on."""
    samples = settings["samples"]
    return f"{samples} samples: datasets" if samples is not None else "samples of which each was seen once: stream"


def _length(settings: Mapping[str, Any], figures: Mapping[str, float]) -> str:
    """How long a network was trained."""
    if "maps" not in figures:
        return f"{figures['epoch']:.0f} epochs to the best of {settings['epochs']} at most"
    return f"{figures['maps']:.0f} maps seen"
