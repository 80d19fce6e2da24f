"""Schema of `dataset.json`."""

import re
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

from scenegen.base.files import Json
from scenegen.base.limits import (
    MAX_KIND_NAME,
    MAX_SAMPLES,
    MAX_SAMPLES_IN_SHARD,
    MAX_SEED,
)

NAME = "dataset.json"
FORMAT = "scenegen-dataset"
VERSION = 2
"""Version of the format. It is raised when an earlier scenegen would misread new files."""

Count = Annotated[int, Meta(ge=0, le=MAX_SAMPLES)]
Seed = Annotated[int, Meta(ge=0, le=MAX_SEED)]
# \A and \Z: msgspec looks for a pattern anywhere in the text
SplitName = Annotated[str, Meta(pattern=r"\A(?:train|val|test)\Z")]
ShardSamples = Annotated[int, Meta(ge=1, le=MAX_SAMPLES_IN_SHARD)]
Digest = Annotated[str, Meta(pattern=r"\A[0-9a-f]{64}\Z")]
SHARD_FILE = re.compile(
    # (?=\1): the digits of a subfolder must begin the names of its files
    r"(?:((?:train|val|test)-[0-9]+)x+/(?=\1))?(train|val|test)-([0-9]{5,9})(\.h5|\.worlds\.zip)"
)
"""Names of a shard's files: train-00000.h5, or train-01xxx/train-01000.worlds.zip."""
FileName = Annotated[str, Meta(pattern=rf"\A(?:{SHARD_FILE.pattern})\Z")]
INDEX_DIGITS = 3
"""Number of final digits that distinguish shards of one folder. The first thousand shards lie in
the dataset's folder, every further thousand in a subfolder: the Hugging Face Hub allows 10,000
entries in a folder."""


class _Table(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table of the file, without unknown names."""


class ShardEntry(_Table, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A shard in the manifest."""

    file: FileName
    worlds: FileName
    split: SplitName
    samples: ShardSamples
    first_world: Count
    sha256: Digest
    worlds_sha256: Digest

    @property
    def sums(self) -> tuple[str, str]:
        """SHA-256 of its two files."""
        return self.sha256, self.worlds_sha256

    @property
    def index(self) -> int:
        """Position in its split."""
        match = SHARD_FILE.fullmatch(self.file)
        assert match is not None
        return int(match[3])


class NoiseEntry(_Table, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Noise of a dataset."""

    stages: Annotated[str, Meta(pattern=r"\A[ -~]{1,4000}\Z")]
    """Stages of noise in the notation of `lidarsim.noise`."""
    bound_m: Annotated[float, Meta(ge=0)] | None
    """Maximum distance of a return from its true place, metres; None if it is unbounded."""
    version: Annotated[int, Meta(ge=1, le=MAX_SEED)]
    """`lidarsim.noise.VERSION` of the software that made the dataset."""


class SceneEntry(_Table, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A world from a file."""

    file: Annotated[str, Meta(max_length=1000)]
    sha256: Digest


class RecipeEntry(_Table, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """All parameters of the recipe, by table, as in a recipe's TOML file."""

    kind: Annotated[str, Meta(pattern=rf"\A(?=.{{1,{MAX_KIND_NAME}}}\Z)\w[\w.-]*(?::\w+)?\Z")]
    version: Seed = 0
    """Version of the kind's preset; 0 for worlds from files."""
    difficulty: Annotated[str, Meta(pattern=r"\A[\w .-]{1,60}\Z")] = "medium"
    world: Json | None = None
    """None for worlds from files."""
    flight: Json
    accept: Json
    lidar: Json
    """Parameters of a raster; for other sensors, the digest of their table of rays."""
    grid: Json
    noise: NoiseEntry | None = None
    mapping: Json
    known: Json | None = None
    """Thresholds for known space in maps of real places; None if there are none."""
    # safe as a default: msgspec copies an empty dict for every object
    parts: dict[str, Json] = {}
    """Settings of optional parts of samples, by name: see `scenegen.draw.parts`."""


class Document(_Table, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The file."""

    format: Literal["scenegen-dataset"] = "scenegen-dataset"
    version: Literal[2] = 2
    generator: Annotated[int, Meta(ge=1, le=MAX_SEED)]
    """`scenegen.GENERATOR` of the software that made the dataset."""
    seed: Seed
    counts: dict[SplitName, Count]
    """Number of samples of each split in the complete dataset."""
    # not `recipe`: a Manifest has that name for the object that the tables describe
    tables: RecipeEntry = msgspec.field(name="recipe")
    scenes: dict[SplitName, list[SceneEntry]] | None = None
    """Worlds of each split from files; None for drawn worlds."""
    like: Digest | None = None
    """Digest of the dataset whose worlds and poses were scanned again, if any."""
    fields: tuple[str, ...]
    """Names of the stored fields."""
    shard_samples: ShardSamples
    engine: Annotated[str, Meta(pattern=r"\A[A-Za-z_][\w.:]{0,199}\Z")]
    """Name of the engine that cast the rays."""
    software: dict[str, Annotated[str, Meta(max_length=200)]]
    complete: bool = False
    shards: tuple[ShardEntry, ...] = ()
    rejected: dict[Literal["worlds", "viewpoints"], dict[str, Count]] = {}
    """Numbers of rejected draws, by reason."""
    digest: Digest | None = None
    """SHA-256 over the digests of all samples; None while shards are missing."""


def stem_of(split: str, index: int) -> str:
    """Name of a shard's files without their endings. It depends on nothing else, so that no file
    moves when a dataset grows.

    Args:
        split: Name of the split.
        index: Position of the shard in its split.
    """
    stem = f"{split}-{index:05d}"
    if index < 10**INDEX_DIGITS:
        return stem
    return f"{stem[:-INDEX_DIGITS]}{'x' * INDEX_DIGITS}/{stem}"


def pattern_of(file: str) -> str:
    """Glob pattern of all files whose names differ from this one in numbers only."""
    return re.sub("-[0-9]+", "-*", file)


def to_json(manifest: Document) -> Json:
    """The file's entries as JSON values."""
    return {
        item.encode_name: msgspec.to_builtins(getattr(manifest, item.name))
        # of the schema alone: a Manifest has further fields, which are not stored
        for item in msgspec.structs.fields(Document)
    }


@dataclass(frozen=True, kw_only=True)
class Numbering:
    """How the samples of a split are numbered; see docs/format.md. Positions may be numbers or
    arrays."""

    viewpoints: int
    """Number of samples of a flight."""
    scenes: int | None
    """Number of worlds from files, which flights visit in turn; None if each flight has a new
    world."""

    def name(self, place: Any) -> tuple[Any, Any]:
        """(world, viewpoint) of the sample at `place` in its split."""
        unit, view = place // self.viewpoints, place % self.viewpoints
        if self.scenes is None:
            return unit, view
        return unit % self.scenes, unit // self.scenes * self.viewpoints + view

    def count(self, samples: int) -> int:
        """Number of worlds of the first `samples` samples."""
        # rounded up: the last flight may be cut
        units = -(-samples // self.viewpoints)
        return units if self.scenes is None else min(units, self.scenes)
