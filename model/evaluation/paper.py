"""What the paper reports, Tables I and II, to stand beside ours."""

import tomllib
from pathlib import Path

Row = dict[str, list[float]]
"""By metric: mean, and standard deviation where the paper gives one."""
_TABLES = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
RECONSTRUCTION: dict[str, dict[str, Row]] = _TABLES["reconstruction"]
"""Rows by kind of worlds and method."""
PLANNING: dict[str, dict[str, Row]] = _TABLES["planning"]
"""The same of paths."""
