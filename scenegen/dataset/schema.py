"""What stands in `dataset.json`: the schema of the file, and nothing else."""

import re
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

from scenegen.base.files import Json
from scenegen.base.limits import (
    MOST_KIND_NAME,
    MOST_SAMPLES,
    MOST_SAMPLES_IN_SHARD,
    MOST_SEED,
)

NAME = "dataset.json"
FORMAT = "scenegen-dataset"
VERSION = 2
"""The version of the format. Whatever an earlier scenegen would misread raises it."""

Count = Annotated[int, Meta(ge=0, le=MOST_SAMPLES)]
Seed = Annotated[int, Meta(ge=0, le=MOST_SEED)]
SplitName = Annotated[str, Meta(pattern=r"\A(?:train|val|test)\Z")]
ShardSamples = Annotated[int, Meta(ge=1, le=MOST_SAMPLES_IN_SHARD)]
Digest = Annotated[str, Meta(pattern=r"\A[0-9a-f]{64}\Z")]
SHARD_FILE = re.compile(
    r"(?:((?:train|val|test)-[0-9]+)x+/(?=\1))?(train|val|test)-([0-9]{5,9})(\.h5|\.worlds\.zip)"
)
"""Where a file of a shard lies: train-00000.h5, or train-01xxx/train-01000.worlds.zip."""
FileName = Annotated[str, Meta(pattern=rf"\A(?:{SHARD_FILE.pattern})\Z")]
INDEX_DIGITS = 3
"""So many last digits tell the shards of one folder apart: the first thousand lie in the dataset's
own, every further thousand in one of theirs. The Hugging Face Hub takes 10,000 entries a folder."""


class _Table(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table of the file: of known names alone."""


class ShardEntry(_Table, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A shard, as the manifest lists it."""

    file: FileName
    worlds: FileName
    split: SplitName
    samples: ShardSamples
    first_world: Count
    sha256: Digest
    worlds_sha256: Digest

    @property
    def sums(self) -> tuple[str, str]:
        """The SHA-256 of its two files."""
        return self.sha256, self.worlds_sha256

    @property
    def index(self) -> int:
        """Its number within its split."""
        match = SHARD_FILE.fullmatch(self.file)
        assert match is not None
        return int(match[3])


class NoiseEntry(_Table, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The noise of a dataset."""

    stages: Annotated[str, Meta(pattern=r"\A[ -~]{1,4000}\Z")]
    """Stages of noise, as `lidarsim.noise` writes them."""
    bound_m: Annotated[float, Meta(ge=0)] | None
    """How far a return may lie from its true place, metres; None where nothing bounds that."""
    version: Annotated[int, Meta(ge=1, le=MOST_SEED)]
    """`lidarsim.noise.VERSION` when it was made."""


class SceneEntry(_Table, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A world that was given as a file."""

    file: Annotated[str, Meta(max_length=1000)]
    sha256: Digest


class RecipeEntry(_Table, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Every parameter of the recipe, by table, as in a recipe's TOML file."""

    kind: Annotated[str, Meta(pattern=rf"\A(?=.{{1,{MOST_KIND_NAME}}}\Z)\w[\w.-]*(?::\w+)?\Z")]
    version: Seed = 0
    """The version of the kind's preset; 0 for worlds from files."""
    difficulty: Annotated[str, Meta(pattern=r"\A[\w .-]{1,60}\Z")] = "medium"
    world: Json | None = None
    """None for worlds from files."""
    flight: Json
    accept: Json
    lidar: Json
    """A raster's parameters; of other sensors the digest of the table of their rays."""
    grid: Json
    noise: NoiseEntry | None = None
    mapping: Json
    known: Json | None = None
    """How much must be known of maps of real places; None where no world is one."""
    parts: dict[str, Json] = {}
    """Parts of samples that were asked for, each with its settings: see `scenegen.draw.parts`."""


class Document(_Table, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The file."""

    format: Literal["scenegen-dataset"] = "scenegen-dataset"
    version: Literal[2] = 2
    generator: Annotated[int, Meta(ge=1, le=MOST_SEED)]
    """`scenegen.GENERATOR` when it was made."""
    seed: Seed
    counts: dict[SplitName, Count]
    """Samples that each split is to hold."""
    tables: RecipeEntry = msgspec.field(name="recipe")
    scenes: dict[SplitName, list[SceneEntry]] | None = None
    """The worlds of each split that were given as files; None where the recipe drew them."""
    like: Digest | None = None
    """Digest of the dataset whose worlds and poses were scanned again; None where flights were
    planned for this one."""
    fields: tuple[str, ...]
    """Names of the fields that shards store."""
    shard_samples: ShardSamples
    engine: Annotated[str, Meta(pattern=r"\A[A-Za-z_][\w.:]{0,199}\Z")]
    """What cast the rays."""
    software: dict[str, Annotated[str, Meta(max_length=200)]]
    complete: bool = False
    shards: tuple[ShardEntry, ...] = ()
    rejected: dict[Literal["worlds", "viewpoints"], dict[str, Count]] = {}
    """Draws that were rejected, by reason."""
    digest: Digest | None = None
    """SHA-256 over the digests of all samples; None as long as shards are missing."""


def stem_of(split: str, index: int) -> str:
    """What the files of a split's shard are called, less their endings. It depends on nothing else,
    so that a dataset grows and no file moves."""
    stem = f"{split}-{index:05d}"
    if index < 10**INDEX_DIGITS:
        return stem
    return f"{stem[:-INDEX_DIGITS]}{'x' * INDEX_DIGITS}/{stem}"


def pattern_of(file: str) -> str:
    """What fits a file's name and those of all others of its sort, in which numbers differ."""
    return re.sub("-[0-9]+", "-*", file)


def to_json(manifest: Document) -> Json:
    """What stands in the file, as plain JSON values."""
    return {
        item.encode_name: msgspec.to_builtins(getattr(manifest, item.name))
        for item in msgspec.structs.fields(Document)
    }


@dataclass(frozen=True, kw_only=True)
class Numbering:
    """How the samples of a split are numbered: docs/format.md. A place may be one number, or an
    array of them."""

    viewpoints: int
    """Samples of one flight."""
    scenes: int | None
    """Worlds from files, which flights visit in turn; None where each flight has a world of its
    own."""

    def name(self, place: Any) -> tuple[Any, Any]:
        """(world, viewpoint) of the sample at `place` in its split."""
        unit, view = place // self.viewpoints, place % self.viewpoints
        if self.scenes is None:
            return unit, view
        return unit % self.scenes, unit // self.scenes * self.viewpoints + view

    def count(self, samples: int) -> int:
        """How many worlds the first so many samples are of."""
        units = -(-samples // self.viewpoints)
        return units if self.scenes is None else min(units, self.scenes)
