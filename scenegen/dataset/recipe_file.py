"""A recipe as a TOML file, every parameter with its value."""

import json
import math
import re
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import msgspec

from lidarsim.noise import VERSION as NOISE_VERSION
from scenegen.dataset.parameters import plain
from scenegen.dataset.schema import NoiseEntry, RecipeEntry
from scenegen.dataset.sensor_file import RAYS
from scenegen.errors import BrokenError, raised_as
from scenegen.files import Json
from scenegen.worlds.mapping import Mapper

if TYPE_CHECKING:
    from lidarsim.noise.chain import Noise


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


def noise_entry(noise: "Noise", max_range_m: float) -> NoiseEntry | None:
    """What a manifest says of noise on a sensor of that range; None without stages. Raises
    BrokenError for noise that no manifest can hold."""
    if not noise.stages:
        return None
    bound_m = noise.bound_m(max_range_m)
    entry = {
        "stages": noise.spelled(),
        "bound_m": bound_m if math.isfinite(bound_m) else None,
        "version": NOISE_VERSION,
    }
    with raised_as(BrokenError, "recipe.noise: "):
        return msgspec.convert(entry, NoiseEntry)


def mapping_entry(mapping: Mapper) -> Json:
    """Every parameter of how maps are made; those of the default for what is the same."""
    return plain(asdict(Mapper() if mapping.plain else mapping))
