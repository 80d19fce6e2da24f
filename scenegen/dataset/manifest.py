"""The manifest, `dataset.json`: how it is read and written, and what follows from it.

`scenegen.dataset.schema` says what stands in the file. `Manifest` adds where the file lies, and the
objects that its tables describe. A manifest may come from a stranger: every value is
checked before it is used, and no module is imported because a manifest names it.
"""

import difflib
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import cached_property
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec import Struct

from lidarsim import GridSpec, Sensor
from lidarsim.noise import STAGES
from scenegen import SPLITS, __version__
from scenegen.base.errors import (
    BrokenError,
    DatasetError,
    NewerError,
    RecipeError,
    StoreError,
    printable,
    raised_as,
    short,
)
from scenegen.base.files import Json, sha256_of, write_whole
from scenegen.base.limits import (
    MOST_MANIFEST_BYTES,
    MOST_RAYS_IN_SAMPLE,
    MOST_VIEWPOINTS,
    MOST_VOXELS,
)
from scenegen.base.stores import ConflictError, Place, Store, read_at
from scenegen.dataset.layout import Layout, layout_of
from scenegen.dataset.parameters import (
    check_sensor_entry,
    configured,
    noise_entry,
    rays_digest,
    sensor_of,
)
from scenegen.dataset.schema import (
    FORMAT,
    NAME,
    VERSION,
    Document,
    NoiseEntry,
    Numbering,
    ShardEntry,
    to_json,
)
from scenegen.draw.parts import PARTS
from scenegen.draw.sample import DERIVED, FIELDS, Schema
from scenegen.worlds.kinds import graded, kind_names
from scenegen.worlds.mapping import Known, Mapper, Sensing

if TYPE_CHECKING:  # which import what draws worlds
    from scenegen.worlds.recipe import Recipe

OF_SHARDS = ("complete", "shards", "rejected", "digest")
"""What a manifest says besides the dataset's parameters, which are known before anything is
drawn."""


class Manifest(Document, frozen=True, dict=True, kw_only=True):
    """A manifest, and where it lies. Whoever reads one calls `check` first, as `load` does."""

    folder: Path = Path()
    named: str | None = None
    """A kind of the user's own that the user named, so that its module may be imported."""

    @property
    def kind(self) -> str:
        """The kind of its worlds; ``scene`` for worlds from files."""
        return self.tables.kind

    @property
    def graded(self) -> str:
        """Its kind, and its difficulty where that is not medium: "maze-hard"."""
        return graded(self.kind, self.tables.difficulty)

    @property
    def parameters(self) -> Json:
        """What is known before anything is drawn, as plain JSON values."""
        document = to_json(self)
        return {name: value for name, value in document.items() if name not in OF_SHARDS}

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of `parameters`, but for the counts of samples. Every shard carries it, so that
        it is not taken for another dataset's; a dataset that grows keeps its shards."""
        kept = {name: value for name, value in self.parameters.items() if name != "counts"}
        return sha256_of(json.dumps(kept, sort_keys=True).encode())

    @property
    def files(self) -> dict[str, str]:
        """Every file that the manifest lists, with its SHA-256."""
        listed = rays_digest(self.tables.lidar)
        for entry in self.shards:
            listed |= {entry.file: entry.sha256, entry.worlds: entry.worlds_sha256}
        return listed

    @cached_property
    def grid(self) -> GridSpec:
        """The grid of its maps. Raises BrokenError."""
        grid: GridSpec = configured(GridSpec, self.tables.grid, "recipe.grid")
        if math.prod(grid.shape) > MOST_VOXELS:
            raise BrokenError(
                f"recipe.grid.shape = {list(grid.shape)}: expected {MOST_VOXELS} voxels at most"
            )
        return grid

    @cached_property
    def lidar(self) -> Sensor:
        """The sensor. Raises BrokenError where the table of its rays is damaged."""
        return sensor_of(self.tables.lidar, self.folder)

    @cached_property
    def mapping(self) -> Mapper:
        """How maps are made. Raises BrokenError."""
        mapping: Mapper = configured(Mapper, self.tables.mapping, "recipe.mapping")
        shape, max_range_m = check_sensor_entry(self.tables.lidar)
        with raised_as(BrokenError):
            mapping.check_reach(self.grid, max_range_m, math.prod(shape), MOST_RAYS_IN_SAMPLE)
        return mapping

    @cached_property
    def known(self) -> Known | None:
        """How much must be known where a sensor scans a real place. Raises BrokenError."""
        entry = self.tables.known
        return None if entry is None else configured(Known, entry, "recipe.known")

    @cached_property
    def parts(self) -> Mapping[str, Any]:
        """The settings of the parts of samples that were asked for. Raises BrokenError."""
        settings = {}
        for name, entry in self.tables.parts.items():
            if name not in PARTS:
                raise NewerError(
                    f"recipe.parts: unknown {short(name)}; expected {', '.join(PARTS)}"
                )
            settings[name] = configured(PARTS[name].settings, entry, f"recipe.parts.{name}")
        return settings

    @property
    def sensing(self) -> Sensing:
        """How its samples were sensed."""
        return Sensing(self.lidar, self.mapping, self.noise_stages)

    @property
    def noise(self) -> NoiseEntry | None:
        """Its noise; None for clean ranges."""
        return self.tables.noise

    @property
    def noise_stages(self) -> str:
        """Its stages of noise as text; "" for clean ranges."""
        return self.tables.noise.stages if self.tables.noise else ""

    @property
    def noise_is_ours(self) -> bool:
        """Whether its noise is scenegen's own, so that nothing that the file names is imported."""
        stages = filter(None, self.noise_stages.split(","))
        return all(stage.partition(":")[0] in STAGES.builtin for stage in stages)

    @property
    def is_drawn(self) -> bool:
        """Whether the recipe can draw the worlds again: they are of a kind known here, or of one
        that the user named."""
        return self.kind in (*kind_names(), self.named)

    @cached_property
    def schema(self) -> Schema:
        """Which fields its samples have."""
        return schema_of(self)

    @cached_property
    def layout(self) -> Layout:
        """What every shard has to hold."""
        return layout_of(self.fields, self.schema)

    def numbering(self, split: str) -> Numbering:
        """How a split's samples are numbered. Raises BrokenError where the recipe does not say."""
        viewpoints = self.tables.flight.get("viewpoints")
        if type(viewpoints) is not int or not 1 <= viewpoints <= MOST_VIEWPOINTS:
            raise BrokenError(
                f"recipe.flight.viewpoints = {short(viewpoints)}: expected a whole number from 1 "
                f"to {MOST_VIEWPOINTS}"
            )
        scenes = None if self.scenes is None else max(len(self.scenes.get(split, ())), 1)
        return Numbering(viewpoints=viewpoints, scenes=scenes)

    def first_place(self, entry: ShardEntry) -> int:
        """The place of a shard's first sample in its split. Raises BrokenError."""
        each = self.numbering(entry.split).viewpoints
        return entry.index * max(self.shard_samples // each, 1) * each

    @cached_property
    def recipe(self) -> "Recipe":
        """What the tables spell out: without a world where the kind is not `is_drawn`, and without
        noise that is not ours. Raises BrokenError."""
        from lidarsim.noise.chain import Noise
        from scenegen.worlds.recipe import make_recipe  # which imports MuJoCo

        entry, kind = self.tables, "scene"
        tables: Json = {"flight": entry.flight, "accept": entry.accept, "grid": asdict(self.grid)}
        if self.is_drawn:
            kind = self.kind
            tables |= {"world": entry.world or {}, "difficulty": entry.difficulty}
        noise = Noise()
        with raised_as(BrokenError, of=(RecipeError, ValueError)):
            recipe = make_recipe(kind, tables, lidar=self.lidar)
            if entry.noise is not None and self.noise_is_ours:
                noise = Noise.parse(entry.noise.stages)
                again = noise_entry(noise, self.lidar.max_range_m)
                if again is None or again.bound_m != entry.noise.bound_m:
                    raise ValueError(
                        f"recipe.noise.bound_m = {entry.noise.bound_m}: its stages have "
                        f"{again and again.bound_m} with this sensor"
                    )
            return replace(
                recipe,
                noise=noise,
                parts=dict(self.parts),
                mapping=self.mapping,
                known=self.known,
            )

    def check(self) -> "Manifest":
        """The manifest itself, where the types that readers rely on can be made of its tables, and
        they fit together. Raises BrokenError."""
        for split in SPLITS:
            if split not in self.counts:
                raise BrokenError(f"counts.{split} is missing: expected a number of samples")
        if self.kind == "scene" and self.scenes is None:
            raise BrokenError("scenes is missing: expected the worlds of each split")
        check_sensor_entry(self.tables.lidar)
        groups = groups_of(self)
        every = [name for name, about in FIELDS.items() if about["group"] in ("", *groups)]
        if list(self.fields) not in (every, [name for name in every if name not in DERIVED]):
            raise BrokenError(
                f"fields = {short(list(self.fields))}: expected {', '.join(every)}, or these "
                f"without {' and '.join(DERIVED)}, as the recipe says"
            )
        for split in SPLITS:
            total = sum(entry.samples for entry in self.shards if entry.split == split)
            asked = self.counts[split]
            if total > asked or (self.complete and total < asked):
                raise BrokenError(f"counts.{split} = {asked}, but its shards hold {total} samples")
        names = sorted(name for entry in self.shards for name in (entry.file, entry.worlds))
        for name, same in groupby(names):
            if len(list(same)) > 1:
                raise BrokenError(f"shards: {name!r} is listed more than once")
        return self


def groups_of(described: "Recipe | Manifest") -> tuple[str, ...]:
    """The groups of fields that samples have besides those that all have."""
    groups = ["earlier"] if described.mapping.scans > 1 else []
    groups += ["known"] if described.known is not None else []
    return (*groups, *described.parts)


def schema_of(described: "Recipe | Manifest") -> Schema:
    """Which fields the samples have. Raises BrokenError where a table of rays is damaged."""
    return Schema(
        grid=described.grid,
        lidar=described.lidar,
        groups=groups_of(described),
        scans=described.mapping.scans,
    )


def encode(manifest: Document) -> bytes:
    """The content of the file."""
    return (json.dumps(to_json(manifest), indent=1) + "\n").encode()


def write(folder: Place, manifest: Manifest) -> None:
    """Replace the manifest of `folder`; at a store, the one that was read last.

    If another run has put one there meanwhile, a complete one stays, and this one takes the place
    of any other; they may list other shards, but none differently. Raises StoreError where it is of
    another dataset.
    """
    content = encode(manifest)
    if not isinstance(folder, Store):
        write_whole(folder / NAME, content)
        return
    while True:  # until no other run puts one between
        try:
            folder.replace(NAME, content)
            return
        except ConflictError:
            stored = read_content(folder)
        if stored == content:
            return
        other = parse(stored)
        if other.parameters != manifest.parameters:
            raise StoreError(
                f"{folder}: another run has begun another dataset there; choose another --out for "
                f"one"
            )
        if other.complete:
            if manifest.complete:
                raise StoreError(
                    f"{folder}: another run has completed it with other bytes; give the same "
                    f"command again"
                )
            return


class _Head(Struct):
    """What is read first, to tell other files and other versions from damaged ones."""

    format: Any = None
    version: Any = None
    software: Any = None


def parse(content: bytes, folder: Path = Path(), named: str | None = None) -> Manifest:
    """The manifest in `content`, which lies in `folder`; `named` is the kind that the user named.

    Raises BrokenError with what is wrong, where, and what was expected; NewerError where a newer
    scenegen wrote it; DatasetError where it is no manifest, or of an earlier format.
    """
    try:
        head = msgspec.json.decode(content, type=_Head)
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
        raise BrokenError(f"is no JSON of a dataset ({printable(error)[:200]})") from None
    if head.format != FORMAT:
        raise DatasetError(f'is not a scenegen dataset\'s, expected "format": "{FORMAT}"')
    version = head.version if isinstance(head.version, int | float) else 0
    if head.version != VERSION:
        if version > VERSION:
            raise NewerError(f"format version {short(head.version)}: this scenegen reads {VERSION}")
        raise DatasetError(
            f"format version {short(head.version)}: scenegen 0.3 reads {VERSION} alone; generate "
            "the dataset again, or read it with scenegen 0.2"
        )
    try:
        document = msgspec.json.decode(content, type=Document)
        values = {name: getattr(document, name) for name in Document.__struct_fields__}
        return Manifest(**values, folder=folder, named=named).check()
    except NewerError:
        raise
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError, BrokenError) as error:
        fault = re.sub(r"^(.*) - at `\$\.?(.*)`$", r"\2: \1", printable(error))
    made_by = head.software.get("scenegen") if isinstance(head.software, dict) else None
    raise NewerError(fault) if _is_later(made_by) else BrokenError(fault)


def _is_later(version: Any) -> bool:
    """Whether a version of scenegen, as a manifest names it, is later than this one."""
    theirs, ours = (
        list(map(int, re.findall(r"[0-9]{1,9}", str(text)[:50]))) for text in (version, __version__)
    )
    return theirs > ours


def load(folder: Path, name: str = "") -> Manifest:
    """The manifest of `folder`, which errors call `name`. Raises DatasetError."""
    where, content = f"{name or folder}: {NAME}", read_content(folder, name)
    try:
        return parse(content, folder)
    except NewerError as error:
        raise DatasetError(
            f"{where}: a newer scenegen wrote it: {error}; read it with that one"
        ) from None
    except BrokenError as error:
        fault = printable(error)[:300]
        raise DatasetError(
            f"{where} is damaged: {fault}; copy the dataset again, or generate it"
        ) from None
    except DatasetError as error:
        raise DatasetError(f"{where} {error}") from None


def read_content(folder: Place, name: str = "") -> bytes:
    """The bytes of the manifest of `folder`, which errors call `name`. Raises DatasetError where
    there is none."""
    try:
        return read_at(folder, NAME, MOST_MANIFEST_BYTES)
    except FileNotFoundError:
        here = Path(str(folder))
        lacks = f"it has no {NAME}" if here.exists() else "there is no such folder"
        inner, others = (
            [str(near.parent) for near in place.glob(f"*/{NAME}")] for place in (here, here.parent)
        )
        for near in sorted(inner)[:1] or difflib.get_close_matches(str(folder), others, 1, 0.8):
            lacks += f"; did you mean {near}?"
        raise DatasetError(
            f"{name or folder}: not a dataset, {lacks}; make one with `scenegen generate`"
        ) from None
    except OSError as error:
        raise DatasetError(
            f"{name or folder}/{NAME}: cannot be read ({printable(error)[:200]})"
        ) from None


def total_digest(digests: Sequence[bytes]) -> str:
    """The digest of a dataset of the digests of its samples, 32 bytes each, in order."""
    return sha256_of(b"".join(digests))
