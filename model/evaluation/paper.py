"""What the paper reports, and how far its figures can be compared with ours."""

import tomllib
from pathlib import Path

PAPER = tomllib.loads(Path(__file__).with_name("paper.toml").read_text(encoding="utf-8"))
"""The paper's Tables I and II, to stand beside ours: by table, kind of worlds, method and metric,
the mean, and the standard deviation where the paper gives one."""
TUNED = (
    "The presets of our worlds were tuned until planning on the true map and on the returns alone "
    "bracketed the paper's Table II or came near it (docs/results/calibration.md), so agreement "
    "with that table is in part by construction."
)
"""What must stand beside the paper's figures, wherever they are printed."""
