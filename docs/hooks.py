"""Puts the page of some samples into the site of the docs; `assets/site.js` shows it in a frame."""

from pathlib import Path
from typing import Any

import scenegen

PAGE = Path("pictures", "look", "live.html")


def on_post_build(config: Any) -> None:
    """Draw three samples of a kind's test split, as anybody gets them, and write their page."""
    samples = scenegen.stream("geometric", split="test")
    scenegen.show([samples[n] for n in (0, 7, 14)], out=Path(config["site_dir"]) / PAGE)
