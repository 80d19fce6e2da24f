"""The recipe and the command that make a dataset again, from its manifest alone, and the check that
they do."""

import dataclasses
import re
import shlex
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lidarsim.engines import DEFAULT
from scenegen import GENERATOR, SPLITS
from scenegen.dataset import manifest
from scenegen.dataset.parts import GRID, sensor_entry, write_rays
from scenegen.dataset.read import Dataset
from scenegen.dataset.trust import Manifest
from scenegen.errors import PublishError, RecipeError, short
from scenegen.recipe import read_recipe
from scenegen.recipes import KINDS
from scenegen.run import undone_if_stopped
from scenegen.source import DrawnWorlds
from scenegen.tables import named_lidar

RECIPE, SENSOR = "recipe.toml", "sensor.toml"
"""What `command` reads: all of a dataset that was drawn, or the sensor of one that was scanned
again."""
ORIGINAL = "ORIGINAL"
"""Stands in `command` for the dataset that was scanned again."""
_NOT_OURS = ("software", "format", "version")
"""Parameters that no recipe decides."""


def source_file(found: Manifest) -> tuple[str, str]:
    """Name and content of the file that `command` reads."""
    title = f"every parameter of the dataset {found.digest}"
    if found.rescan is None:
        return RECIPE, recipe_text(found.parameters, title)
    given = {name: value for name, value in found.parameters["lidar"].items() if name != "shape"}
    return SENSOR, "\n".join(
        [f"# the sensor of the dataset {found.digest}", *_entries(given)]
    ) + "\n"


def command(found: Manifest, out: str) -> str:
    """What to type, next to what `source_file` says, to make the dataset of a manifest again in the
    folder `out`."""
    if found.rescan is not None:
        words = ["scenegen", "rescan", ORIGINAL, "--lidar", SENSOR]
        if found.noise is not None:
            words += ["--noise", found.noise["stages"]]
        made = found.mapping  # in full, since nothing here says how the original's maps are made
        words += ["--scans", str(made.scans), "--fusion", made.fusion]
        words += ["--scan-spacing", str(made.scan_spacing_m)] if made.scans > 1 else []
        words += ["--map-ahead", ",".join(map(str, made.map_ahead_m))]
        return shlex.join([*words, "--engine", found.engine, "--out", out])
    words = ["scenegen", "generate", "--recipe", RECIPE]
    if found.kind == "scene":
        words += ["--scene", "SCENES"]
    words += ["--n", str(found.counts["train"])]
    for split in SPLITS[1:]:
        words += [f"--{split}", str(found.counts[split])]
    words += ["--seed", str(found.seed), "--shard-samples", str(found.shard_samples)]
    if "tudf" not in found.fields:
        words.append("--compact")
    if found.labels is not None:
        words += ["--labels", found.labels["by"]]
    if found.engine != DEFAULT:
        words += ["--engine", found.engine]
    return shlex.join([*words, "--out", out])


def recipe_text(parameters: Mapping[str, Any], title: str) -> str:
    """A recipe file with every parameter of a manifest, so that no preset's later version changes
    anything; `title` is its first line."""
    tables = {name: parameters["recipe"].get(name) for name in ("world", "flight", "accept")}
    # a table of rays has its shape in the file
    tables["lidar"] = {
        name: value for name, value in parameters["lidar"].items() if name != "shape"
    }
    tables["noise"] = {"stages": parameters["noise"]["stages"]} if parameters.get("noise") else None
    tables["mapping"] = parameters.get("mapping")
    tables["grid"] = {GRID[name]: value for name, value in parameters["grid"].items()}
    lines = [f"# {title}", f"kind = {_toml(parameters['kind'])}"]
    if sources := parameters.get("sources"):
        lines[1] = 'kind = "mixed"'
        for source in sources:
            own = source["parameters"]
            lines += ["", "[[component]]", f"kind = {_toml(own['kind'])}"]
            lines.append(f"weight = {_toml(sum(own['counts'].values()))}")
            for name in ("world", "flight", "accept"):
                if own["recipe"].get(name):
                    lines += ["", f"[component.{name}]", *_entries(own["recipe"][name])]
        common = {name: tables[name] for name in ("lidar", "noise", "mapping", "grid")}
        # before the components, whose tables would else take them in
        lines[2:2] = _tables(common)
        return "\n".join(lines) + "\n"
    return "\n".join([*lines, *_tables(tables)]) + "\n"


def _tables(tables: Mapping[str, Any]) -> list[str]:
    lines: list[str] = []
    for name, table in tables.items():
        if table is not None:
            lines += ["", f"[{name}]", *_entries(table)]
    return lines


def _entries(table: Mapping[str, Any]) -> list[str]:
    return [f"{_key(key)} = {_toml(value)}" for key, value in table.items()]


def check_kind(there: str, named: str | None) -> None:
    """Raise PublishError for a dataset of kind `there` whose worlds only a module of somebody's own
    can draw, unless the user `named` it: no module is imported because a manifest names it."""
    if there != "scene" and there not in KINDS.known and there != named:
        raise PublishError(
            f"the dataset's kind, {short(there)}, is none of scenegen's own, and only its module "
            f"can say whether the "
            "recipe makes the same worlds again; give --kind with its name to have it imported"
        )


def check_source(dataset: Dataset, name: str, text: str) -> None:
    """Read the file `name` that holds `text` as `command` would, next to the dataset's files, and
    hold what it resolves to against the manifest.

    Raises PublishError where this version would make another dataset of it.
    """
    found = dataset.manifest
    if not found.noise_is_ours:
        raise PublishError(
            f"its noise, {short(dict(found.noise or {}))}, has stages that are none of scenegen's "
            f"own, which are not "
            "imported; it cannot be said whether its command makes the same ranges again"
        )
    with tempfile.TemporaryDirectory() as folder, undone_if_stopped(lambda: shutil.rmtree(folder)):
        path = Path(folder, name)
        path.write_text(text, encoding="utf-8")
        write_rays(dataset.lidar, path.parent)
        try:
            if found.rescan is not None:
                ours = {"generator": GENERATOR, "lidar": sensor_entry(named_lidar(str(path)))}
                _check_same(found, {name: found.parameters.get(name) for name in ours}, ours)
                return
            recipe = read_recipe(path)
        except RecipeError as error:
            raise PublishError(
                f"{_advice(found)}: {str(error).removeprefix(f'{path}: ')}"
            ) from None
    given = manifest.parameters(
        dataclasses.replace(recipe, labels=found.recipe.labels),
        DrawnWorlds(recipe),
        seed=found.seed,
        counts=found.counts,
        compact="tudf" not in found.fields,
        shard_samples=found.shard_samples,
        engine=found.engine,
    )
    there = {
        name: value
        for name, value in manifest.completed(found.parameters).items()
        if name not in _NOT_OURS
    }
    there["recipe"] = {name: value for name, value in found.tables.items() if name != "scenes"}
    _check_same(
        found,
        there,
        {name: value for name, value in manifest.completed(given).items() if name not in _NOT_OURS},
    )


def _check_same(found: Manifest, there: Mapping[str, Any], here: Mapping[str, Any]) -> None:
    if wrong := manifest.differences(there, here):
        raise PublishError(f"{_advice(found)}: {wrong[0]}")


def _advice(found: Manifest) -> str:
    made, generator = found.software.get("scenegen", "of another version"), found.generator
    return (
        f"this scenegen would not make the same dataset again; publish with the one that made it, "
        f"{made} with "
        f"generator {generator}, or generate it anew"
    )


def _key(name: str) -> str:
    """A key in TOML: a manifest's may come from a stranger, and must not add lines of its own."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name, re.ASCII) else _toml(name)


def _toml(value: Any) -> str:
    """A plain value in TOML."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return f"[{', '.join(_toml(item) for item in value)}]"
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    return repr(value)
