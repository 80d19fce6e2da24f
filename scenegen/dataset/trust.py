"""What readers rely on in a manifest, checked before they do: it may come from a stranger."""

import math
from collections import Counter
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import pydantic

from lidarsim import GridSpec
from lidarsim.engines import MUJOCO
from scenegen import SPLITS
from scenegen.dataset import manifest
from scenegen.dataset.sensor import files_of
from scenegen.dataset.shard import stored_fields
from scenegen.errors import MOST_TOLD, BrokenError, DatasetError, printable, short
from scenegen.limits import MOST_SAMPLES, MOST_SAMPLES_IN_SHARD, MOST_SEED, MOST_VOXELS
from scenegen.sample import SCHEMA

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


class _Counts(pydantic.BaseModel, strict=True):
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
    counts: _Counts
    recipe: _Recipe
    fields: Annotated[list[str], pydantic.Field(max_length=len(SCHEMA))]
    grid: _Grid
    lidar: dict[str, str | int | float | list[int]]
    engine: Annotated[str, pydantic.Field(pattern=r"^[A-Za-z_][\w.:]*$", max_length=200)] = MUJOCO
    shard_samples: Annotated[int, pydantic.Field(ge=1, le=MOST_SAMPLES_IN_SHARD)]
    shards: list[Entry]
    rejected: dict[Literal["worlds", "viewpoints"], dict[str, _Count]]
    digest: _Digest | None
    software: dict[str, str]


def typed(found: Mapping[str, Any]) -> Manifest:
    """A manifest whose values have the types and bounds that readers rely on. Raises BrokenError."""
    try:
        checked = Manifest.model_validate(found)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        at = printable(".".join(str(step) for step in first["loc"]))
        raise BrokenError(f"{at[:MOST_TOLD]} = {short(first['input'])}: {first['msg']}") from None
    if math.prod(checked.grid.shape) > MOST_VOXELS:
        raise BrokenError(f"grid.shape = {short(checked.grid.shape)}: expected {MOST_VOXELS} voxels at most")
    if tuple(checked.fields) not in (stored_fields(compact=False), stored_fields(compact=True)):
        raise BrokenError(f"fields = {short(checked.fields)}: expected all, or all but the derived ones")
    listed = Counter(name for entry in checked.shards for name in (entry.file, entry.worlds))
    for name, count in listed.most_common(1):
        if count > 1:
            raise BrokenError(f"shards: {name!r} is listed {count} times, expected once")
    return checked


def check_manifest(found: Mapping[str, Any], name: str) -> tuple[Manifest, GridSpec]:
    """A manifest by which samples can be read, and its grid; `name` stands in errors.

    Raises DatasetError for a value of a wrong type or beyond reason, and for shards that are no dataset's files, or
    not as many samples as the counts say.
    """
    try:
        checked = typed(found)
        for split in SPLITS:
            total, asked = sum(e.samples for e in checked.shards if e.split == split), getattr(checked.counts, split)
            if total > asked or (checked.complete and total < asked):
                raise BrokenError(f"counts.{split} = {asked}, but its shards hold {total} samples")
        files_of(found["lidar"])
        return checked, manifest.grid_of(found)
    except (BrokenError, ValueError, TypeError, OverflowError) as error:
        wrong = printable(error)[:300]
    raise DatasetError(f"{name}: {manifest.NAME} is damaged: {wrong}; copy the dataset again, or generate it")
