"""The manifest, `dataset.json`: how it is read and written, and the objects that its tables
describe.

`scenegen.dataset.schema` defines the file's schema. A manifest may come from an untrusted source:
every value is checked before it is used, and no module is imported because a manifest names it.
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
from lidarsim.parameters import short_repr
from scenegen import SPLITS, __version__
from scenegen.base.errors import (
    CorruptFileError,
    DatasetError,
    RecipeError,
    StoreError,
    UnsupportedVersionError,
    printable,
    reraise_as,
)
from scenegen.base.files import Json, write_atomic
from scenegen.base.limits import (
    MAX_MANIFEST_BYTES,
    MAX_RAYS_IN_SAMPLE,
    MAX_VIEWPOINTS,
    MAX_VOXELS,
)
from scenegen.base.reading import sha256_of
from scenegen.base.stores import ConflictError, Location, Store, read_at
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

if TYPE_CHECKING:
    from scenegen.worlds.recipe import Recipe


OF_SHARDS = ("complete", "shards", "rejected", "digest")
"""Entries that depend on the shards. All others are known before anything is drawn."""


# dict: without it, a Struct has no `__dict__`, which cached properties write to
class Manifest(Document, frozen=True, dict=True, kw_only=True):
    """A manifest, and the folder it was read from. `parse` and `load` return checked ones."""

    folder: Path = Path()
    named: str | None = None
    """A user's own kind that the user named, which allows importing its module."""

    @property
    def kind(self) -> str:
        """Kind of its worlds; ``scene`` for worlds from files."""
        return self.tables.kind

    @property
    def graded(self) -> str:
        """Its kind, with the difficulty unless that is medium: "maze-hard"."""
        return graded(self.kind, self.tables.difficulty)

    @property
    def parameters(self) -> Json:
        """All entries that are known before anything is drawn, as JSON values."""
        document = to_json(self)
        return {name: value for name, value in document.items() if name not in OF_SHARDS}

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of `parameters` without the numbers of samples, so that a growing dataset keeps
        its shards. Every shard stores it as the mark of its dataset."""
        parameters = {name: value for name, value in self.parameters.items() if name != "counts"}
        # sorted keys, as docs/format.md defines the mark: other programs compute it, too
        return sha256_of(json.dumps(parameters, sort_keys=True).encode())

    @property
    def files(self) -> dict[str, str]:
        """SHA-256 of every file that the manifest lists, by name."""
        listed = rays_digest(self.tables.lidar)
        for entry in self.shards:
            listed |= {entry.file: entry.sha256, entry.worlds: entry.worlds_sha256}
        return listed

    @cached_property
    def grid(self) -> GridSpec:
        """Grid of the maps.

        Raises:
            CorruptFileError: if it is invalid or too large.
        """
        grid: GridSpec = configured(GridSpec, self.tables.grid, "recipe.grid")
        if math.prod(grid.shape) > MAX_VOXELS:
            raise CorruptFileError(
                f"recipe.grid.shape = {list(grid.shape)}: expected {MAX_VOXELS} voxels at most"
            )
        return grid

    @cached_property
    def lidar(self) -> Sensor:
        """The sensor. Raises CorruptFileError if its table of rays is damaged."""
        return sensor_of(self.tables.lidar, self.folder)

    @cached_property
    def mapping(self) -> Mapper:
        """The mapper. Raises CorruptFileError if it is invalid, or does not fit the grid and
        sensor."""
        mapping: Mapper = configured(Mapper, self.tables.mapping, "recipe.mapping")
        shape, max_range_m = check_sensor_entry(self.tables.lidar)
        with reraise_as(CorruptFileError):
            mapping.check_reach(self.grid, max_range_m, math.prod(shape), MAX_RAYS_IN_SAMPLE)
        return mapping

    @cached_property
    def known(self) -> Known | None:
        """Thresholds for known space in maps of real places. Raises CorruptFileError if they are
        invalid."""
        entry = self.tables.known
        return None if entry is None else configured(Known, entry, "recipe.known")

    @cached_property
    def parts(self) -> Mapping[str, Any]:
        """Settings of the optional parts of samples, by name.

        Raises:
            UnsupportedVersionError: if a part is unknown.
            CorruptFileError: if its settings are invalid.
        """
        settings = {}
        for name, entry in self.tables.parts.items():
            if name not in PARTS:
                raise UnsupportedVersionError(
                    f"recipe.parts: unknown {short_repr(name)}; expected {', '.join(PARTS)}"
                )
            settings[name] = configured(PARTS[name].settings, entry, f"recipe.parts.{name}")
        return settings

    @property
    def sensing(self) -> Sensing:
        """How the samples were sensed."""
        return Sensing(self.lidar, self.mapping, self.noise_stages)

    @property
    def noise(self) -> NoiseEntry | None:
        """The noise; None for clean ranges."""
        return self.tables.noise

    @property
    def noise_stages(self) -> str:
        """Stages of noise as text; "" for clean ranges."""
        return self.tables.noise.stages if self.tables.noise else ""

    @property
    def noise_is_ours(self) -> bool:
        """Whether all stages of noise are scenegen's own. Others are not imported."""
        stages = filter(None, self.noise_stages.split(","))
        return all(stage.partition(":")[0] in STAGES.builtin for stage in stages)

    @property
    def is_drawn(self) -> bool:
        """Whether the recipe can draw the worlds again: their kind is known here, or the user named
        it."""
        return self.kind in (*kind_names(), self.named)

    @cached_property
    def schema(self) -> Schema:
        """Schema of the samples."""
        return schema_of(self)

    @cached_property
    def layout(self) -> Layout:
        """Layout of every shard."""
        return layout_of(self.fields, self.schema)

    def numbering(self, split: str) -> Numbering:
        """How a split's samples are numbered.

        Raises:
            CorruptFileError: if the recipe has no valid `flight.viewpoints`.
        """
        viewpoints = self.tables.flight.get("viewpoints")
        # the schema does not cover the recipe's tables; a bool is no number
        if type(viewpoints) is not int or not 1 <= viewpoints <= MAX_VIEWPOINTS:
            raise CorruptFileError(
                f"recipe.flight.viewpoints = {short_repr(viewpoints)}: expected a whole number "
                "from 1 "
                f"to {MAX_VIEWPOINTS}"
            )
        # at least 1, as a split without worlds has no units, and must not divide by zero
        scenes = None if self.scenes is None else max(len(self.scenes.get(split, ())), 1)
        return Numbering(viewpoints=viewpoints, scenes=scenes)

    def first_place(self, entry: ShardEntry) -> int:
        """Position of a shard's first sample in its split. Raises CorruptFileError."""
        viewpoints = self.numbering(entry.split).viewpoints
        return entry.index * max(self.shard_samples // viewpoints, 1) * viewpoints

    @cached_property
    def recipe(self) -> "Recipe":
        """The recipe; without a world unless `is_drawn`, and without noise that is not ours.

        Raises:
            CorruptFileError: if a table is invalid, or `bound_m` does not follow from the noise.
        """
        from lidarsim.noise.chain import Noise
        from scenegen.worlds.recipe import make_recipe  # which imports MuJoCo

        entry, kind = self.tables, "scene"
        tables: Json = {"flight": entry.flight, "accept": entry.accept, "grid": asdict(self.grid)}
        if self.is_drawn:
            kind = self.kind
            tables |= {"world": entry.world or {}, "difficulty": entry.difficulty}
        noise = Noise()
        with reraise_as(CorruptFileError, of=(RecipeError, ValueError)):
            recipe = make_recipe(kind, tables, lidar=self.lidar)
            if entry.noise is not None and self.noise_is_ours:
                noise = Noise.parse(entry.noise.stages)
                # checks of samples rely on `bound_m`, so it must follow from the stages
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
        """Check that the tables are valid, and consistent with the list of shards.

        Returns:
            The manifest itself.

        Raises:
            CorruptFileError: if they are not.
        """
        for split in SPLITS:
            if split not in self.counts:
                raise CorruptFileError(f"counts.{split} is missing: expected a number of samples")
        if self.complete and self.digest is None:
            raise CorruptFileError("digest is missing: expected that of all samples")
        if self.kind == "scene" and self.scenes is None:
            raise CorruptFileError("scenes is missing: expected the worlds of each split")
        check_sensor_entry(self.tables.lidar)
        groups = groups_of(self)
        expected = [name for name, entry in FIELDS.items() if entry["group"] in ("", *groups)]
        if list(self.fields) not in (expected, [name for name in expected if name not in DERIVED]):
            raise CorruptFileError(
                f"fields = {short_repr(list(self.fields))}: expected {', '.join(expected)}, or "
                "these "
                f"without {' and '.join(DERIVED)}, as the recipe says"
            )
        for split in SPLITS:
            total = sum(entry.samples for entry in self.shards if entry.split == split)
            promised = self.counts[split]
            # an incomplete dataset may lack shards, but has none too many
            if total > promised or (self.complete and total < promised):
                raise CorruptFileError(
                    f"counts.{split} = {promised}, but its shards hold {total} samples"
                )
        names = sorted(name for entry in self.shards for name in (entry.file, entry.worlds))
        for name, entries in groupby(names):
            if len(list(entries)) > 1:
                raise CorruptFileError(f"shards: {name!r} is listed more than once")
        return self


def groups_of(described: "Recipe | Manifest") -> tuple[str, ...]:
    """Groups of fields that the samples have beyond those of all datasets."""
    groups = ["earlier"] if described.mapping.scans > 1 else []
    groups += ["known"] if described.known is not None else []
    return (*groups, *described.parts)


def schema_of(described: "Recipe | Manifest") -> Schema:
    """Schema of the samples. Raises CorruptFileError if a table of rays is damaged."""
    return Schema(
        grid=described.grid,
        lidar=described.lidar,
        groups=groups_of(described),
        scans=described.mapping.scans,
        after_s=getattr(described.parts.get("movers"), "after_s", -math.inf),
    )


def encode(manifest: Document) -> bytes:
    """Content of the file."""
    return (json.dumps(to_json(manifest), indent=1) + "\n").encode()


def write(folder: Location, manifest: Manifest) -> None:
    """Replace the manifest of a folder; at a store, the version that was read last.

    If another run replaced it meanwhile, a complete manifest stays, and an incomplete one is
    replaced. Manifests of such runs differ only in the shards that they list.

    Raises:
        StoreError: if the other manifest has other parameters, or completes the dataset with other
            bytes.
    """
    content = encode(manifest)
    if not isinstance(folder, Store):
        write_atomic(folder / NAME, content)
        return
    while True:  # until no other run replaces it in between
        try:
            folder.replace(NAME, content)
            return
        except ConflictError:
            stored = read_content(folder)
        # our own request succeeded, and its answer was lost
        if stored == content:
            return
        stored_manifest = parse(stored)
        if stored_manifest.parameters != manifest.parameters:
            raise StoreError(
                f"{folder}: another run has begun another dataset there; choose another --out for "
                f"one"
            )
        if stored_manifest.complete:
            if manifest.complete:
                raise StoreError(
                    f"{folder}: another run has completed it with other bytes; give the same "
                    f"command again"
                )
            return


class _Head(Struct):
    """Entries that are read first, to distinguish other files and other versions from damaged
    files."""

    format: Any = None
    version: Any = None
    software: Any = None


def parse(content: bytes, folder: Path = Path(), named: str | None = None) -> Manifest:
    """Parse and check a manifest.

    Args:
        content: The file.
        folder: Its folder.
        named: A user's own kind that may be imported.

    Raises:
        CorruptFileError: if it is damaged. The message has the location, the value, and what was
            expected.
        UnsupportedVersionError: if a newer scenegen wrote it.
        DatasetError: if it is no manifest, or has an earlier format.
    """
    try:
        head = msgspec.json.decode(content, type=_Head)
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
        raise CorruptFileError(f"is no JSON of a dataset ({printable(error)[:200]})") from None
    if head.format != FORMAT:
        raise DatasetError(f'is not a scenegen dataset\'s, expected "format": "{FORMAT}"')
    version = head.version if isinstance(head.version, int | float) else 0
    if head.version != VERSION:
        if version > VERSION:
            raise UnsupportedVersionError(
                f"format version {short_repr(head.version)}: this scenegen reads {VERSION}"
            )
        raise DatasetError(
            f"format version {short_repr(head.version)}: scenegen 0.3 reads {VERSION} alone; "
            "generate "
            "the dataset again, or read it with scenegen 0.2"
        )
    try:
        document = msgspec.json.decode(content, type=Document)
        values = {name: getattr(document, name) for name in Document.__struct_fields__}
        return Manifest(**values, folder=folder, named=named).check()
    except UnsupportedVersionError:
        raise
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError, CorruptFileError) as error:
        # msgspec appends the location; our messages begin with it
        fault = re.sub(r"^(.*) - at `\$\.?(.*)`$", r"\2: \1", printable(error))
    made_by = head.software.get("scenegen") if isinstance(head.software, dict) else None
    # an unknown entry in a file of a later version is no damage
    raise UnsupportedVersionError(fault) if _is_later(made_by) else CorruptFileError(fault)


def _is_later(version: Any) -> bool:
    """Whether a version of scenegen, as a manifest names it, is later than this one."""
    theirs, ours = (
        # bounded lengths, as the text is untrusted
        list(map(int, re.findall(r"[0-9]{1,9}", str(text)[:50])))
        for text in (version, __version__)
    )
    return theirs > ours


def load(folder: Path, name: str = "") -> Manifest:
    """Read the manifest of a folder.

    Args:
        folder: The folder.
        name: Name of the dataset in messages; by default the folder.

    Raises:
        DatasetError: if there is no manifest, it is damaged, or a newer scenegen wrote it.
    """
    path, content = f"{name or folder}: {NAME}", read_content(folder, name)
    try:
        return parse(content, folder)
    except UnsupportedVersionError as error:
        raise DatasetError(
            f"{path}: a newer scenegen wrote it: {error}; read it with that one"
        ) from None
    except CorruptFileError as error:
        fault = printable(error)[:300]
        raise DatasetError(
            f"{path} is damaged: {fault}; copy the dataset again, or generate it"
        ) from None
    except DatasetError as error:
        raise DatasetError(f"{path} {error}") from None


def read_content(folder: Location, name: str = "") -> bytes:
    """Read the bytes of a folder's manifest.

    Args:
        folder: The folder, or a store.
        name: Name of the dataset in messages; by default the folder.

    Raises:
        DatasetError: if there is no manifest, or it cannot be read.
    """
    try:
        return read_at(folder, NAME, MAX_MANIFEST_BYTES)
    except FileNotFoundError:
        path = Path(str(folder))
        problem = f"it has no {NAME}" if path.exists() else "there is no such folder"
        inner, siblings = (
            [str(near.parent) for near in parent.glob(f"*/{NAME}")]
            for parent in (path, path.parent)
        )
        # suggest a dataset inside the folder, or one with a similar name beside it
        for near in sorted(inner)[:1] or difflib.get_close_matches(str(folder), siblings, 1, 0.8):
            problem += f"; did you mean {near}?"
        raise DatasetError(
            f"{name or folder}: not a dataset, {problem}; make one with `scenegen generate`"
        ) from None
    except OSError as error:
        raise DatasetError(
            f"{name or folder}/{NAME}: cannot be read ({printable(error)[:200]})"
        ) from None


def total_digest(digests: Sequence[bytes]) -> str:
    """Digest of a dataset from the digests of its samples, 32 bytes each, in order."""
    return sha256_of(b"".join(digests))
