"""The manifest, `dataset.json`: everything needed to read, check and regenerate a dataset."""

import dataclasses
import hashlib
import json
import platform
from collections import Counter
from collections.abc import Iterable, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from lidarsim import GridSpec, Lidar
from scenegen import GENERATOR, SPLITS, __version__
from scenegen.dataset.shard import ShardReport, stored_fields
from scenegen.errors import DatasetError
from scenegen.files import write_whole
from scenegen.limits import MOST_MANIFEST_BYTES
from scenegen.recipe import Recipe
from scenegen.source import Source

NAME = "dataset.json"
FORMAT = "scenegen-dataset"
VERSION = 1
PACKAGES = ("mujoco", "ompl", "numpy", "numba", "trimesh")
"""What the numbers depend on besides scenegen itself."""

PARAMETERS = (
    *("format", "version", "generator", "kind", "seed", "counts", "recipe", "fields", "grid", "lidar"),
    *("shard_samples", "software"),
)
"""Names of all `parameters`; `generator` is absent from manifests of the first."""


def parameters(
    recipe: Recipe, source: Source, *, seed: int, counts: Mapping[str, int], compact: bool, shard_samples: int
) -> dict[str, Any]:
    """The part of the manifest that is known before anything is drawn, and decides everything after."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "generator": GENERATOR,
        "kind": recipe.kind,
        "seed": seed,
        "counts": {split: counts[split] for split in SPLITS},
        "recipe": _plain(recipe.resolved() | ({"scenes": source.describe()} if source.describe() else {})),
        "fields": list(stored_fields(compact)),
        "grid": {
            "shape": list(recipe.grid.shape),
            "voxel": recipe.grid.voxel_m,
            "truncation": recipe.grid.truncation_m,
        },
        "lidar": _plain(dataclasses.asdict(recipe.lidar)),
        "shard_samples": shard_samples,
        "software": software(),
    }


def software() -> dict[str, str]:
    """Versions of what the numbers depend on."""
    found = {"scenegen": __version__, "machine": platform.machine()}
    return found | {package: installed(package) for package in PACKAGES}


def installed(package: str) -> str:
    """The installed version of a package, or ``absent``."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "absent"


def fingerprint(given: Mapping[str, Any]) -> str:
    """A digest of `parameters`, the same for the same dataset."""
    return hashlib.sha256(json.dumps(given, sort_keys=True).encode()).hexdigest()


def parameters_of(found: Mapping[str, Any]) -> dict[str, Any]:
    """The `parameters` of a manifest, as they stand in it."""
    return {name: found[name] for name in PARAMETERS if name in found}


def completed(found: Mapping[str, Any]) -> dict[str, Any]:
    """The `parameters` of a manifest, with the generator, which manifests of the first do not name."""
    return {"generator": 1} | parameters_of(found)


def differences(there: Mapping[str, Any], asked: Mapping[str, Any], prefix: str = "") -> list[str]:
    """Where two sets of parameters differ: "name: there, asked", nested names joined by dots."""
    found = []
    for name in [*there, *(name for name in asked if name not in there)]:
        old, new = there.get(name, "absent"), asked.get(name, "absent")
        if isinstance(old, dict) and isinstance(new, dict):
            found += differences(old, new, f"{prefix}{name}.")
        elif old != new:
            found.append(f"{prefix}{name} is {json.dumps(old)} there, {json.dumps(new)} asked for")
    return found


def assemble(given: Mapping[str, Any], reports: Iterable[ShardReport], *, complete: bool) -> dict[str, Any]:
    """The manifest of the shards reported, in order."""
    reports = list(reports)
    worlds: Counter[str] = Counter()
    viewpoints: Counter[str] = Counter()
    for report in reports:
        worlds.update(report.rejected.worlds)
        viewpoints.update(report.rejected.viewpoints)
    digest = hashlib.sha256(b"".join(report.digests for report in reports)).hexdigest()
    return {
        **given,
        "complete": complete,
        "shards": [report.entry() for report in reports],
        "rejected": {"worlds": dict(sorted(worlds.items())), "viewpoints": dict(sorted(viewpoints.items()))},
        "digest": digest if complete else None,
    }


def write(folder: Path, manifest: Mapping[str, Any]) -> None:
    """Replace the manifest of `folder`."""
    write_whole(folder / NAME, (json.dumps(manifest, indent=1) + "\n").encode())


def read(folder: Path) -> dict[str, Any]:
    """The manifest of `folder`. Raises DatasetError where it has none that this version can read."""
    path = folder / NAME
    try:
        if path.exists() and not path.is_file():
            raise DatasetError(f"{path}: is no file, expected a manifest; choose another folder")
        with open(path, "rb") as file:  # however large it grows meanwhile
            content = file.read(MOST_MANIFEST_BYTES + 1)
        if len(content) > MOST_MANIFEST_BYTES:
            raise DatasetError(
                f"{path}: larger than {MOST_MANIFEST_BYTES >> 20} MB, which no manifest is; choose another folder"
            )
        manifest = json.loads(content.decode())
    except (FileNotFoundError, NotADirectoryError):
        raise DatasetError(f"{folder}: not a dataset, it has no {NAME}; make one with `scenegen generate`") from None
    except RecursionError:
        raise DatasetError(f"{path}: nested without end, which no manifest is; choose another folder") from None
    except (OSError, ValueError) as error:
        raise DatasetError(
            f"{path}: cannot be read ({error}); copy the dataset again, or generate it in another folder"
        ) from None
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT or "shards" not in manifest:
        raise DatasetError(f'{path}: not a scenegen dataset, expected "format": "{FORMAT}"')
    if manifest.get("version") != VERSION:
        raise DatasetError(
            f"{path}: format version {manifest.get('version')}, this scenegen reads {VERSION}; install one that matches"
        )
    return manifest


def grid_of(manifest: Mapping[str, Any]) -> GridSpec:
    """The grid of a dataset."""
    grid = manifest["grid"]
    return GridSpec(shape=tuple(grid["shape"]), voxel_m=grid["voxel"], truncation_m=grid["truncation"])


def lidar_of(manifest: Mapping[str, Any]) -> Lidar:
    """The sensor of a dataset."""
    return Lidar(**manifest["lidar"])


def _plain(value: Any) -> Any:
    """`value` as JSON would give it back."""
    return json.loads(json.dumps(value))
