"""Puts pages of some samples into the site of the docs; `assets/site.js` shows them in frames."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import scenegen
from scenegen.worlds.recipe import preset
from scenegen.worlds.traffic import PRESETS

PAGES = Path("pictures", "look")


def on_post_build(config: Any) -> None:
    """Draw samples of test splits, as anybody gets them, and write their pages: of a kind, and of
    a street with movers."""
    street = preset("street")
    parts, mapping = {"movers": PRESETS["dense"]}, replace(street.mapping, scans=3)
    moving = replace(street, parts=parts, mapping=mapping)
    shown = {"page": ("geometric", (0, 7, 14)), "movers": (moving, (7, 6, 25))}
    for name, (worlds, numbers) in shown.items():
        samples = scenegen.stream(worlds, split="test")
        out = Path(config["site_dir"]) / PAGES / f"{name}.html"
        scenegen.show([samples[n] for n in numbers], out=out)
