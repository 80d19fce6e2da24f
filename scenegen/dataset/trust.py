"""What readers rely on in a manifest and in a shard, checked before they do: either may come from a stranger."""

import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import h5py
import numpy as np
import pydantic

from lidarsim import GridSpec, Lidar
from scenegen.dataset import manifest
from scenegen.errors import DatasetError
from scenegen.limits import MOST_ASSET_BYTES, MOST_SAMPLES, MOST_SAMPLES_IN_SHARD, MOST_SEED, MOST_VOXELS
from scenegen.sample import SCHEMA, shape_of

SHARD_FILE = r"^(train|val|test)-[0-9]{5,9}(\.h5|\.worlds\.zip)$"
"""What a file of a dataset may be called, besides the manifest."""

_Count = Annotated[int, pydantic.Field(ge=0, le=MOST_SAMPLES)]
_File = Annotated[str, pydantic.Field(pattern=SHARD_FILE, max_length=40)]
_Digest = Annotated[str, pydantic.Field(pattern="^[0-9a-f]{64}$", max_length=64)]


class Entry(pydantic.BaseModel, strict=True, frozen=True):
    """A shard, as the manifest lists it."""

    file: _File
    worlds: _File
    split: Literal["train", "val", "test"]
    samples: Annotated[int, pydantic.Field(ge=1, le=MOST_SAMPLES_IN_SHARD)]
    first_world: _Count
    sha256: _Digest
    worlds_sha256: _Digest


class _Grid(pydantic.BaseModel, strict=True):
    shape: Annotated[list[Annotated[int, pydantic.Field(ge=1)]], pydantic.Field(min_length=3, max_length=3)]
    voxel: float
    truncation: float


class Counts(pydantic.BaseModel, strict=True):
    """Samples of each split."""

    train: _Count
    val: _Count
    test: _Count


class _Recipe(pydantic.BaseModel, strict=True):
    version: int = 0
    world: dict[str, Any] | None = None
    flight: dict[str, Any] = {}
    accept: dict[str, Any] = {}


class Manifest(pydantic.BaseModel, strict=True):
    """The types and bounds of what readers rely on."""

    complete: bool
    generator: Annotated[int, pydantic.Field(ge=1)] = 1
    kind: Annotated[str, pydantic.Field(pattern=r"^\w[\w.-]*$", max_length=100)]
    seed: Annotated[int, pydantic.Field(ge=0, le=MOST_SEED)]
    counts: Counts | None = None  # this and `shard_samples` are for making it again, not for reading
    recipe: _Recipe
    fields: Annotated[list[str], pydantic.Field(max_length=len(SCHEMA))]
    grid: _Grid
    lidar: dict[str, str | int | float]
    shard_samples: Annotated[int, pydantic.Field(ge=1, le=MOST_SAMPLES_IN_SHARD)] | None = None
    shards: list[Entry]
    rejected: dict[Literal["worlds", "viewpoints"], dict[str, _Count]]
    digest: _Digest | None
    software: dict[str, str]


def check_manifest(found: Mapping[str, Any], name: str) -> tuple[GridSpec, Lidar]:
    """The grid and the sensor of a manifest, if it is one by which samples can be read; `name` stands in errors.

    Raises DatasetError for a value of a wrong type or beyond reason, and for shards that are no dataset's files.
    """
    where = f"{name}: {manifest.NAME}"
    try:
        Manifest.model_validate(found)
        if math.prod(found["grid"]["shape"]) > MOST_VOXELS:
            raise ValueError(f"grid.shape = {found['grid']['shape']}: expected {MOST_VOXELS} voxels at most")
        for field, meta in SCHEMA.items():
            if field not in found["fields"] and not meta["derived"]:
                raise ValueError(f"fields: {field} is missing")
        if unknown := set(found["fields"]) - set(SCHEMA):
            raise ValueError(f"fields: {_short(min(unknown))} is not known")
        return manifest.grid_of(found), manifest.lidar_of(found)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        at = ".".join(str(step) for step in first["loc"])
        wrong = f"{at} = {_short(first['input'])}: {first['msg']}"
    except (ValueError, TypeError) as error:
        wrong = " ".join(str(error).split())
    raise DatasetError(f"{where} is damaged: {wrong}; copy the dataset again, or generate it")


def check_shard(file: h5py.File, fields: list[str], samples: int, grid: GridSpec, lidar: Lidar) -> None:
    """Raise DatasetError where an open shard does not hold `samples` samples of `fields`, in itself, as it should."""
    for name in fields:
        wrong = ""
        link = file.get(name, getlink=True)
        stored = file[name] if isinstance(link, h5py.HardLink) else None
        expected = (samples, *shape_of(name, grid, lidar))
        if not isinstance(stored, h5py.Dataset) or stored.is_virtual or stored.external:
            wrong = "is not stored in it"
        elif stored.shape != expected or stored.dtype != np.dtype(SCHEMA[name]["dtype"]):
            wrong = f"is {stored.dtype} {stored.shape}, expected {np.dtype(SCHEMA[name]['dtype'])} {expected}"
        elif stored.chunks is not None and math.prod(stored.chunks) > math.prod(expected):
            wrong = f"has chunks of {stored.chunks}"
        if wrong:
            raise DatasetError(f"{Path(file.filename)}: {name} {wrong}; copy the dataset again, or generate it")


def read_member(archive: zipfile.ZipFile, name: str) -> bytes:
    """A file of a world's archive. Raises ValueError for one that is huge, or whose name is more than a name, since it
    will be written beside the world under it."""
    if not name.isprintable() or set(name) & set("/\\:") or name.startswith("."):
        raise ValueError(f"holds {_short(name)}, expected plain names")
    size = archive.getinfo(name).file_size
    if size > MOST_ASSET_BYTES:
        raise ValueError(f"{_short(name)} has {size} bytes, expected {MOST_ASSET_BYTES} at most")
    return archive.read(name)


def _short(value: object) -> str:
    """A value for an error's line, cut where it is long."""
    said = ascii(value)
    return said if len(said) <= 60 else f"{said[:57]}..."
