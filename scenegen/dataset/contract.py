"""What a manifest promises: the objects that its tables describe, checked."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from functools import cached_property
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidarsim import GridSpec, Sensor
from lidarsim.noise import STAGES
from scenegen import SPLITS
from scenegen.base.errors import BrokenError, NewerError, RecipeError, raised_as, short
from scenegen.base.files import Json
from scenegen.base.limits import MOST_RAYS_IN_SAMPLE, MOST_VIEWPOINTS, MOST_VOXELS
from scenegen.base.reading import sha256_of
from scenegen.dataset.layout import Layout, layout_of
from scenegen.dataset.parameters import (
    check_sensor_entry,
    configured,
    noise_entry,
    rays_digest,
    sensor_of,
)
from scenegen.dataset.schema import Document, NoiseEntry, Numbering, ShardEntry, to_json
from scenegen.draw.parts import PARTS
from scenegen.draw.sample import DERIVED, FIELDS, Schema
from scenegen.worlds.kinds import graded, kind_names
from scenegen.worlds.mapping import Known, Mapper, Sensing

if TYPE_CHECKING:  # importing recipes loads the code that draws worlds
    from scenegen.worlds.recipe import Recipe


OF_SHARDS = ("complete", "shards", "rejected", "digest")
"""Entries that depend on the shards. All others are known before anything is drawn."""


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
            BrokenError: if it is invalid or too large.
        """
        grid: GridSpec = configured(GridSpec, self.tables.grid, "recipe.grid")
        if math.prod(grid.shape) > MOST_VOXELS:
            raise BrokenError(
                f"recipe.grid.shape = {list(grid.shape)}: expected {MOST_VOXELS} voxels at most"
            )
        return grid

    @cached_property
    def lidar(self) -> Sensor:
        """The sensor. Raises BrokenError if its table of rays is damaged."""
        return sensor_of(self.tables.lidar, self.folder)

    @cached_property
    def mapping(self) -> Mapper:
        """The mapper. Raises BrokenError if it is invalid, or does not fit the grid and sensor."""
        mapping: Mapper = configured(Mapper, self.tables.mapping, "recipe.mapping")
        shape, max_range_m = check_sensor_entry(self.tables.lidar)
        with raised_as(BrokenError):
            mapping.check_reach(self.grid, max_range_m, math.prod(shape), MOST_RAYS_IN_SAMPLE)
        return mapping

    @cached_property
    def known(self) -> Known | None:
        """Thresholds for known space in maps of real places. Raises BrokenError if they are
        invalid."""
        entry = self.tables.known
        return None if entry is None else configured(Known, entry, "recipe.known")

    @cached_property
    def parts(self) -> Mapping[str, Any]:
        """Settings of the optional parts of samples, by name.

        Raises:
            NewerError: if a part is unknown.
            BrokenError: if its settings are invalid.
        """
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
            BrokenError: if the recipe has no valid `flight.viewpoints`.
        """
        viewpoints = self.tables.flight.get("viewpoints")
        # the schema does not cover the recipe's tables; a bool is no number
        if type(viewpoints) is not int or not 1 <= viewpoints <= MOST_VIEWPOINTS:
            raise BrokenError(
                f"recipe.flight.viewpoints = {short(viewpoints)}: expected a whole number from 1 "
                f"to {MOST_VIEWPOINTS}"
            )
        # at least 1, as a split without worlds has no units, and must not divide by zero
        scenes = None if self.scenes is None else max(len(self.scenes.get(split, ())), 1)
        return Numbering(viewpoints=viewpoints, scenes=scenes)

    def first_place(self, entry: ShardEntry) -> int:
        """Position of a shard's first sample in its split. Raises BrokenError."""
        viewpoints = self.numbering(entry.split).viewpoints
        return entry.index * max(self.shard_samples // viewpoints, 1) * viewpoints

    @cached_property
    def recipe(self) -> "Recipe":
        """The recipe; without a world unless `is_drawn`, and without noise that is not ours.

        Raises:
            BrokenError: if a table is invalid, or `bound_m` does not follow from the noise.
        """
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
            BrokenError: if they are not.
        """
        for split in SPLITS:
            if split not in self.counts:
                raise BrokenError(f"counts.{split} is missing: expected a number of samples")
        if self.complete and self.digest is None:
            raise BrokenError("digest is missing: expected that of all samples")
        if self.kind == "scene" and self.scenes is None:
            raise BrokenError("scenes is missing: expected the worlds of each split")
        check_sensor_entry(self.tables.lidar)
        groups = groups_of(self)
        expected = [name for name, entry in FIELDS.items() if entry["group"] in ("", *groups)]
        if list(self.fields) not in (expected, [name for name in expected if name not in DERIVED]):
            raise BrokenError(
                f"fields = {short(list(self.fields))}: expected {', '.join(expected)}, or these "
                f"without {' and '.join(DERIVED)}, as the recipe says"
            )
        for split in SPLITS:
            total = sum(entry.samples for entry in self.shards if entry.split == split)
            promised = self.counts[split]
            # an incomplete dataset may lack shards, but has none too many
            if total > promised or (self.complete and total < promised):
                raise BrokenError(
                    f"counts.{split} = {promised}, but its shards hold {total} samples"
                )
        names = sorted(name for entry in self.shards for name in (entry.file, entry.worlds))
        for name, entries in groupby(names):
            if len(list(entries)) > 1:
                raise BrokenError(f"shards: {name!r} is listed more than once")
        return self


def groups_of(described: "Recipe | Manifest") -> tuple[str, ...]:
    """Groups of fields that the samples have beyond those of all datasets."""
    groups = ["earlier"] if described.mapping.scans > 1 else []
    groups += ["known"] if described.known is not None else []
    return (*groups, *described.parts)


def schema_of(described: "Recipe | Manifest") -> Schema:
    """Schema of the samples. Raises BrokenError if a table of rays is damaged."""
    return Schema(
        grid=described.grid,
        lidar=described.lidar,
        groups=groups_of(described),
        scans=described.mapping.scans,
    )
