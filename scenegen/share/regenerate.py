"""The recipe and the command that make a dataset again, from its manifest alone, and the check that
they do."""

import dataclasses
import json
import platform
import re
import shlex
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from fractions import Fraction
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Any

from lidarsim.engines import DEFAULT
from lidarsim.noise import VERSION
from scenegen import GENERATOR, SPLITS, __version__
from scenegen.dataset import manifest
from scenegen.dataset.generation import plan_mixed, read_components, shares
from scenegen.dataset.parts import GRID, rays_named, sensor_entry, write_rays
from scenegen.dataset.read import Dataset
from scenegen.dataset.trust import Manifest
from scenegen.errors import BrokenError, PublishError, RecipeError, short
from scenegen.files import Json
from scenegen.limits import MOST_RECIPE_BYTES
from scenegen.recipe import read_recipe
from scenegen.recipes import KINDS
from scenegen.run import undone_if_stopped
from scenegen.run.software import commit
from scenegen.source import DrawnWorlds
from scenegen.tables import named_lidar

RECIPE, SENSOR = "recipe.toml", "sensor.toml"
"""What `command` reads: all of a dataset that was drawn, or the sensor of one that was scanned
again."""
ORIGINAL = "ORIGINAL"
"""Stands in `command` for the dataset that was scanned again."""
_NOT_OURS = ("software", "format", "version", "engine")
"""Parameters that no recipe decides."""
MOST_PARTS = 10_000
"""The largest sum of weights that is looked for."""


def source_file(found: Manifest) -> tuple[str, str]:
    """Name and content of the file that `command` reads."""
    if found.rescan is None:
        return RECIPE, recipe_text(
            found.parameters, f"every parameter of the dataset {found.digest}"
        )
    sensor = _lidar(found.parameters, found.rays)
    lines = _table(f"# the sensor of the dataset {found.digest}", sensor)
    return SENSOR, "\n".join([*lines[1:], ""])


def command(found: Manifest, out: str) -> str:
    """What to type, next to what `source_file` says, to make the dataset of a manifest again in the
    folder `out`."""
    if found.rescan is not None:
        made = found.mapping  # in full, since nothing here says how the original's maps are made
        words = ["scenegen", "rescan", ORIGINAL, "--lidar", SENSOR]
        given = {
            "noise": found.noise and found.noise["stages"],
            "scans": made.scans,
            "fusion": made.fusion,
            "scan-spacing": made.scan_spacing_m if made.scans > 1 else None,
            "map-ahead": ",".join(map(str, made.map_ahead_m)),
            "engine": found.engine,
        }
    else:
        words = ["scenegen", "generate", "--recipe", RECIPE]
        words += ["--compact"] if "tudf" not in found.fields else []
        given = {
            "scene": "SCENES" if found.kind == "scene" else None,
            "n": found.counts["train"],
            **{split: found.counts[split] for split in SPLITS[1:]},
            "seed": found.homes[0].seed,
            "shard-samples": found.shard_samples,
            "labels": found.labels and found.labels["by"],
            "engine": None if found.engine == DEFAULT else found.engine,
        }
    for option, value in (given | {"out": out}).items():
        words += [] if value is None else [f"--{option}", str(value)]
    return shlex.join(words)


def recipe_text(parameters: Json, title: str) -> str:
    """A recipe file with every parameter of a manifest, so that no preset's later version changes
    anything; `title` is its first line."""
    sources = [source["parameters"] for source in parameters.get("sources") or ()]
    components = [
        _tables(component, rays_named(parameters)) for component in sources or [parameters]
    ]
    lines = _table(f"# {title}", {"kind": "mixed"} if sources else _preset(parameters))[1:]
    first = components[0]
    common = [name for name in first if all(other[name] == first[name] for other in components)]
    for name in common:
        lines += _table(f"[{name}]", first[name])
    if sources:
        weights = _weights([source["counts"] for source in sources])
        for source, weight, tables in zip(sources, weights, components, strict=True):
            lines += _table("[[component]]", _preset(source) | {"weight": weight})
            for name, table in tables.items():
                if name not in common:
                    lines += _table(f"[component.{name}]", table)
    return "\n".join([*lines, ""])


def _weights(counts: Sequence[Mapping[str, int]]) -> list[int]:
    """The least weights by which components come out with these `counts` of samples by split; where
    none are found, their samples."""
    splits = [[count[split] for count in counts] for split in SPLITS]
    largest = max(splits, key=sum)
    samples = sum(largest)
    # weights whose sum is `total` are about the shares of the largest split
    for total in range(len(counts), min(samples, MOST_PARTS) + 1):
        weights = [Fraction(round(Fraction(count * total, samples))) for count in largest]
        if all(weights) and all(shares(sum(split), weights) == split for split in splits):
            return [int(weight) for weight in weights]
    return [sum(count.values()) for count in counts]


def _preset(parameters: Json) -> Json:
    """A kind of worlds, and its difficulty where that is not medium."""
    level = parameters["recipe"].get("difficulty")
    return {"kind": parameters["kind"]} | ({"difficulty": level} if level else {})


def _tables(parameters: Json, files: Mapping[str, str]) -> dict[str, Json | None]:
    """Every table of a recipe; tables of rays lie in `files`, by their SHA-256."""
    noise, recipe = parameters.get("noise"), parameters["recipe"]
    return {
        **{name: recipe.get(name) for name in ("world", "flight", "accept")},
        "lidar": _lidar(parameters, files),
        "noise": noise and {"stages": noise["stages"]},
        "mapping": parameters.get("mapping"),
        "known": parameters.get("known"),
        "grid": {GRID[name]: value for name, value in parameters["grid"].items()},
    }


def _lidar(parameters: Json, files: Mapping[str, str]) -> Json:
    """The table [lidar]; a table of rays has its shape in the file."""
    table = {name: value for name, value in parameters["lidar"].items() if name != "shape"}
    return table | ({"rays": files[table["sha256"]]} if "rays" in table else {})


def _table(head: str, table: Json | None) -> list[str]:
    if table is None:
        return []
    return ["", head, *(f"{_key(key)} = {_toml(value)}" for key, value in table.items())]


def check_kind(there: str, named: str | None) -> None:
    """Raise PublishError for a dataset of kind `there` whose worlds only a module of somebody's own
    can draw, unless the user `named` it: no module is imported because a manifest names it."""
    if there != "scene" and there not in KINDS.builtin and there != named:
        raise PublishError(
            f"the dataset's kind, {short(there)}, is none of scenegen's own, and only its module "
            "can say whether the recipe makes the same worlds again; give --kind with its name to "
            "have it imported"
        )


def check_source(dataset: Dataset, name: str, text: str) -> None:
    """Read the file `name` that holds `text` as `command` would, next to the dataset's files, and
    hold what it resolves to against the manifest.

    Raises PublishError where this version would make another dataset of it, or it is too long.
    """
    if (size := len(text.encode())) > MOST_RECIPE_BYTES:
        raise PublishError(
            f"its recipe would have {size} bytes, expected {MOST_RECIPE_BYTES} at most; generate "
            "it of fewer components, or with fewer domain.draws"
        )
    found = dataset.manifest
    for home in found.homes:
        if home.noise_is_ours:
            continue
        raise PublishError(
            f"its noise, {short(dict(home.noise or {}))}, has stages that are none of scenegen's "
            "own, which are not imported; it cannot be said whether its command makes the same "
            "ranges again"
        )
    with tempfile.TemporaryDirectory() as folder, undone_if_stopped(lambda: shutil.rmtree(folder)):
        path = Path(folder, name)
        path.write_text(text, encoding="utf-8")
        write_rays([sensing.lidar for sensing in dataset.settings], path.parent)
        try:
            if found.rescan is not None:
                here = {
                    "generator": GENERATOR,
                    "lidar": sensor_entry(named_lidar(str(path))),
                    "noise": found.noise and {**found.noise, "version": VERSION},
                }
                there = {name: found.parameters.get(name) for name in here}
            else:
                here, there = _decided(_read_again(found, path)), _decided(found.parameters)
        except (RecipeError, BrokenError) as error:
            said = str(error).removeprefix(f"{path}: ")
            raise PublishError(f"{_advice(found)}: {said}") from None
    if wrong := manifest.differences(there, here):
        raise PublishError(f"{_advice(found)}: {wrong[0]}")


def _read_again(found: Manifest, path: Path) -> Json:
    """The parameters that the recipe in `path` makes with the counts and the seed of a manifest."""
    labels = found.homes[0].recipe.labels
    read = read_components(path) if found.sources else [(read_recipe(path), Fraction(1))]
    parts = [(dataclasses.replace(recipe, labels=labels), weight) for recipe, weight in read]
    asked: Json = {
        "seed": found.homes[0].seed,
        "counts": found.counts,
        "compact": "tudf" not in found.fields,
        "shard_samples": found.shard_samples,
    }
    if found.sources:
        return plan_mixed(path.parent, parts, **asked).parameters
    ((recipe, _),) = parts
    return manifest.parameters(recipe, DrawnWorlds(recipe), **asked)


def _decided(parameters: Json) -> Json:
    """The part of a manifest's `parameters` that a recipe decides."""
    left = manifest.completed(parameters)
    found = {name: it for name, it in left.items() if name not in _NOT_OURS}
    found["recipe"] = {name: it for name, it in found["recipe"].items() if name != "scenes"}
    if "sources" in found:
        found["sources"] = [_decided(one["parameters"]) for one in found["sources"]]
    return found


def _advice(found: Manifest) -> str:
    made, generator = found.software.get("scenegen", "of another version"), found.generator
    return (
        "this scenegen would not make the same dataset again; publish with the one that made it, "
        f"{made} with generator {generator}, or generate it anew"
    )


def _key(name: str) -> str:
    """A key in TOML: a manifest's may come from a stranger, and must not add lines of its own."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name, re.ASCII) else _toml(name)


def _toml(value: Any) -> str:
    """A plain value in TOML."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml, value))}]"
    return repr(value) if isinstance(value, float) else json.dumps(value, ensure_ascii=False)


def environment_lock(made_with: Mapping[str, str]) -> str:
    """A requirements file of what scenegen needs, as installed here.

    Packages in `made_with`, the manifest's `software`, come in the version that made the dataset.
    scenegen itself stands in a comment, with the commit of its checkout: it is installed from its
    own source, and a line here would ask a package index for whatever bears its name there.
    """
    made = made_with.get("scenegen", __version__)
    python = f"{platform.python_implementation()} {platform.python_version()}"
    lines = [
        f"# scenegen {made}, published with {__version__}, commit {commit()}",
        f"# {python}, {platform.system()} {platform.machine()}",
    ]
    for name, number in sorted(closure("scenegen-lidar").items()):
        lines.append(f"{name}=={made_with.get(name, number)}")
    return "\n".join([*lines, ""])


def closure(package: str) -> dict[str, str]:
    """Name to version of every installed distribution that `package` needs, without extras, and
    without itself."""
    found, needed = dict[str, str](), [package]
    for name in needed:  # which grows meanwhile
        with suppress(PackageNotFoundError):  # for another platform or Python
            found[name] = version(name)
            lines = [line for line in requires(name) or () if "extra" not in line.partition(";")[2]]
            others = [re.split(r"[^\w.-]", line, maxsplit=1)[0] for line in lines]
            plain = [re.sub(r"[-_.]+", "-", other).lower() for other in others]
            needed += [other for other in plain if other not in needed]
    del found[package]
    return found
