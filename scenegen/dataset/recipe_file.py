"""A recipe as a TOML file, every parameter with its value."""

import json
import re
from typing import Any

from scenegen.dataset.schema import RecipeEntry
from scenegen.dataset.sensor_file import RAYS
from scenegen.files import Json


def recipe_text(recipe: RecipeEntry, title: str) -> str:
    """A recipe file with every parameter of a manifest's recipe, so that no preset's later version
    changes anything; `title` is its first line."""
    lines = [f"# {title}", f"kind = {_toml(recipe.kind)}"]
    if recipe.difficulty != "medium":
        lines.append(f"difficulty = {_toml(recipe.difficulty)}")
    lidar = {name: value for name, value in recipe.lidar.items() if name != "shape"}
    if "sensor" in lidar:
        lidar["rays"] = RAYS
    tables: dict[str, Json | None] = {
        "world": recipe.world,
        "flight": recipe.flight,
        "accept": recipe.accept,
        "lidar": lidar,
        "noise": {"stages": recipe.noise.stages} if recipe.noise else None,
        "mapping": recipe.mapping,
        "known": recipe.known,
        "grid": recipe.grid,
    }
    for name, table in tables.items():
        if table is not None:
            lines += ["", f"[{name}]"]
            lines += [f"{_key(key)} = {_toml(value)}" for key, value in table.items()]
    return "\n".join([*lines, ""])


def _key(name: str) -> str:
    """A key in TOML: a manifest's may come from a stranger, and must not add lines of its own."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name, re.ASCII) else _toml(name)


def _toml(value: Any) -> str:
    """A plain value in TOML."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml, value))}]"
    return repr(value) if isinstance(value, float) else json.dumps(value, ensure_ascii=False)
