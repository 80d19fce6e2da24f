"""`generate --like`: repeat a dataset from its manifest, or scan its worlds and poses with another
sensor or noise."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from lidarsim import Pose, Sensor
from lidarsim.engines import ENGINES, EngineFactory
from lidarsim.grid import Floats
from lidarsim.noise.chain import Noise
from lidarsim.parameters import short_repr
from scenegen import GENERATOR, __version__
from scenegen.base.errors import CorruptFileError, DatasetError, GenerationError, reraise_as
from scenegen.base.files import Json, real_path
from scenegen.base.paths import check_type, type_of
from scenegen.base.stores import Location
from scenegen.dataset import manifest
from scenegen.dataset.build import plan_dataset, recipe_entry
from scenegen.dataset.locate import locate
from scenegen.dataset.manifest import Manifest
from scenegen.dataset.parameters import differences
from scenegen.dataset.read import Dataset
from scenegen.dataset.schema import NAME, to_json
from scenegen.dataset.shard import ShardSpec, find_engine
from scenegen.dataset.state import DatasetPlan
from scenegen.draw.draw import (
    FLIGHT,
    Unit,
    UnitKey,
    ViewpointData,
    none_rejected,
    samples_of,
    scans_from,
    times_of,
    times_of_scans,
    truth_of,
)
from scenegen.draw.source import DrawnWorlds, Source
from scenegen.worlds.flight import Sees, plan_flight, viewpoints
from scenegen.worlds.recipe import Recipe
from scenegen.worlds.world import AnyWorld


def fly_again(
    world: AnyWorld, poses: Sequence[Pose], recipe: Recipe, key: UnitKey, sees: Sees | None
) -> list[list[Pose]]:
    """Repeat the flight of a unit, to find the poses of earlier scans that were not stored.

    The flight is recognised by its passing exactly through all stored positions.

    Args:
        world: The world.
        poses: Stored pose of each sample.
        recipe: Gives the flight, and the mapping that needs earlier scans.
        key: Key of the unit's random numbers.
        sees: What the original's recipe tells of the world, see `Recipe.sees`.

    Returns:
        For each sample its own pose, then those of earlier scans, latest first.

    Raises:
        GenerationError: if no draw gives this flight.
    """
    for attempt in range(recipe.accept.max_draws):
        # the random numbers of `draw_unit`, which give the same flights
        rng = key.rng(FLIGHT, attempt)
        for _ in range(recipe.flight.flights_per_world):
            path = plan_flight(world, recipe.flight, rng=rng, sees=sees)
            if path is None:
                continue
            route, passed = viewpoints(path, recipe.flight.spacing_m, rng=rng)
            positions, _ = route.at(passed)
            places = [np.flatnonzero((positions == pose.position).all(axis=1)) for pose in poses]
            # compared to the last bit: a similar flight would be another one
            if all(len(place) == 1 for place in places):
                return [
                    [pose, *route.before(passed[place[0]], recipe.mapping)]
                    for pose, place in zip(poses, places, strict=True)
                ]
    raise GenerationError(
        f"{key.split} flight {key.unit} comes out otherwise here, so that nobody knows where "
        "earlier scans were made; generate the dataset with --scans, or scan it again with the "
        "software that made it"
    )


def scan_again(
    world: AnyWorld,
    poses: Sequence[Sequence[Pose]],
    times: Sequence[Floats],
    recipe: Recipe,
    key: UnitKey,
    *,
    names: tuple[int, int],
    derived: bool = True,
    engine: EngineFactory,
) -> Unit:
    """Scan the viewpoints of a unit again, with the recipe's sensor and noise.

    Only noise is random, and nothing is rejected. With the settings of the original dataset, the
    same samples result, bit for bit.

    Args:
        world: The world.
        poses: Poses of each sample's scans: its own, then earlier ones, latest first.
        times: When each of these scans began, seconds.
        recipe: Gives sensor, noise, mapping and grid.
        key: Key of the unit's random numbers.
        names: Number of the world, and number of the first sample's viewpoint.
        derived: Whether samples have `tudf`.
        engine: Makes the engine that casts rays.

    Raises:
        GenerationError: if a scan fails.
    """
    views = []
    for before, times_s in zip(poses, times, strict=True):
        scans = scans_from(before, times_s, world, engine, recipe)
        truth = truth_of(world, scans[0], recipe, float(times_s[0]))
        views.append(ViewpointData(scans, times_s, truth))
    samples = samples_of(views, recipe, world, engine, key, names, derived)
    return Unit(names[0], world, samples, none_rejected())


@dataclass(frozen=True, eq=False)
class Archived(Source):
    """Worlds of a dataset as a `Source`: read from its archives, never drawn."""

    folder: Path

    @cached_property
    def dataset(self) -> Dataset:
        """The dataset, opened once per process. It is checked while it is read, as new data would
        hide its faults."""
        return Dataset(self.folder, checked=True)

    def __getstate__(self) -> dict[str, Any]:
        # every process opens the dataset for itself: HDF5 handles cannot be pickled
        return {"folder": self.folder}

    def describe(self) -> Json:
        """Worlds from files as in the original's manifest; see `Source.describe`."""
        scenes = to_json(self.dataset.manifest)["scenes"]
        return scenes or {}

    def number(self, split: str, unit: int) -> tuple[int, int]:
        """Find the world of a unit; see `Source.number`.

        Returns:
            Number of the world in its split, and how many earlier units visit it.
        """
        numbering = self.dataset.manifest.numbering(split)
        world, viewpoint = numbering.name(unit * numbering.viewpoints)
        return world, viewpoint // numbering.viewpoints

    def world(self, split: str, number: int, *, rng: np.random.Generator) -> AnyWorld:
        """Read a world; see `Source.world`. Nothing is drawn.

        Returns:
            The world.
        """
        return self._world(split, number)

    @lru_cache(maxsize=8)  # noqa: B019 (several flights visit a world from a file)
    def _world(self, split: str, number: int) -> AnyWorld:
        return self.dataset.compile(split, number)


@dataclass(frozen=True)
class ScanAgain(ShardSpec):
    """A shard whose units are scanned again."""

    def draw(self, unit: int) -> Unit:
        """Scan the original's unit again with the recipe's sensor and noise; see `Units.draw`."""
        source: Any = self.source
        dataset, viewpoints = source.dataset, self.recipe.flight.viewpoints
        samples = dataset.split(self.split)[unit * viewpoints : (unit + 1) * viewpoints]
        number, turn = source.number(self.split, unit)
        # any numbers will do: an archived world is not drawn
        world = source.world(self.split, number, rng=np.random.default_rng(0))
        key = UnitKey(self.seed, self.split, unit)
        mapping, original = self.recipe.mapping, dataset.manifest.mapping
        prefix = f"{dataset.folder}: {self.split} sample: "
        with reraise_as(DatasetError, prefix, "; verify the dataset"):
            poses = [[scan.pose for scan in sample.scans()[: mapping.scans]] for sample in samples]
        times = [times_of(sample, self.recipe)[: mapping.scans] for sample in samples]
        # stored earlier poses serve if the new mapping needs no others
        if mapping.scans > original.scans or mapping.scan_spacing_m != original.scan_spacing_m:
            own_poses = [stored[0] for stored in poses]
            # in a map, flights end where the original's sensor saw enough, not another one
            sees = dataset.manifest.recipe.sees(world)
            poses = fly_again(world, own_poses, self.recipe, key, sees)
            times = [times_of_scans(float(own[0]), self.recipe) for own in times]
        return scan_again(
            world,
            poses,
            times,
            self.recipe,
            key,
            names=(number, turn * viewpoints),
            derived=self.derived,
            engine=find_engine(self.engine),
        )


def plan_like(
    name: str | Path,
    folder: Location,
    *,
    kind: str | None = None,
    lidar: Sensor | None = None,
    noise: Noise | None = None,
    mapping: Mapping[str, Any] | None = None,
    engine: str | None = None,
    **options: Any,
) -> DatasetPlan:
    """Plan a dataset like another one. Settings that are not given are copied.

    Without changes, drawn worlds are drawn again by recipe and seed: the samples are the same, bit
    for bit. Otherwise the worlds are scanned again from the same poses. Flights are repeated only
    if more earlier scans, or other ones, are needed.

    Args:
        name: The dataset; or its manifest, if worlds are drawn again.
        folder: Location of the new dataset.
        kind: Name of the dataset's kind if it is a user's own, which allows importing its module.
        lidar: Another sensor.
        noise: Other noise; an empty chain for none.
        mapping: Changed parameters of the `Mapper`.
        engine: Name of another engine.
        options: As for `plan_dataset`: `counts`, if worlds are drawn again; `compact`.

    Returns:
        The plan.

    Raises:
        DatasetError: if there is no such dataset, or this version would make another one.
    """
    path = locate(name)
    is_file = path.is_file()
    if type_of(path) not in (None, "dataset") and path.name != NAME:
        check_type(path, "dataset")
    original = _manifest_of(path, kind)
    folder_of_original = path.parent if is_file else path
    if real_path(folder) == real_path(folder_of_original):
        raise DatasetError(f"{folder}: is the dataset itself; choose another folder with --out")
    if engine is None and original.engine not in ENGINES.builtin:
        raise DatasetError(
            f"{name}: made with the engine {short_repr(original.engine)}, which is not "
            "imported because "
            "a manifest names it; give --engine with its name, or one of ours"
        )
    if not original.noise_is_ours and noise is None:
        raise DatasetError(
            f"{name}: its noise, {short_repr(original.noise_stages)}, has stages that are none of "
            "scenegen's own, which are not imported because a manifest names them; give --noise"
        )
    if pose_settings := sorted({"tilt_mps", "settle_s", "most_tilt_deg"} & set(mapping or {})):
        raise DatasetError(
            f"{name}: its samples keep their poses, and {pose_settings[0]} would tilt others; "
            "generate a dataset with it"
        )
    engine = engine or original.engine
    find_engine(engine)
    with reraise_as(DatasetError, f"{name}: ", of=(CorruptFileError, ValueError)):
        recipe = original.recipe
        changed = replace(
            recipe,
            lidar=lidar or recipe.lidar,
            noise=recipe.noise if noise is None else noise,
            mapping=replace(recipe.mapping, **(mapping or {})),
        )
    planned: dict[str, Any] = {
        "seed": original.seed,
        "counts": original.counts,
        "compact": "tudf" not in original.fields,
        "shard_samples": original.shard_samples,
        "engine": engine,
    }
    planned |= options
    is_changed = changed != recipe or engine != original.engine
    if not is_changed and original.is_drawn and original.like is None:
        check_same(original, name)
        return plan_dataset(folder, changed, DrawnWorlds(changed), **planned)
    if "counts" in options:
        raise DatasetError(
            f"{name}: is scanned again from the same poses, so that the numbers of samples stay; "
            "leave them out"
        )
    if is_file:
        raise DatasetError(
            f"{name}: is a manifest alone, and its worlds and poses are needed; give the dataset"
        )
    if not original.complete:
        raise DatasetError(f"{name}: is incomplete; give the command that made it again")
    # the entry of the worlds stays as it was, even if their kind is not installed here
    drawn_by = {
        field: getattr(original.tables, field)
        for field in ("kind", "version", "difficulty", "world", "flight", "accept")
    }
    return plan_dataset(
        folder,
        changed,
        Archived(path),
        tables=msgspec.structs.replace(recipe_entry(changed), **drawn_by),
        like=original.digest,
        shard_type=ScanAgain,
        **planned,
    )


def _manifest_of(path: Path, kind: str | None) -> Manifest:
    """Read the manifest of a dataset folder or file. Raises DatasetError."""
    folder = path.parent if path.is_file() else path
    original = manifest.load(folder)
    if kind is not None:
        if kind != original.kind:
            raise DatasetError(f"--kind {kind}: the dataset's kind is {short_repr(original.kind)}")
        original = manifest.parse(manifest.read_content(folder), folder, kind)
    return original


def check_same(original: Manifest, name: str | Path) -> None:
    """Check that this version draws the same worlds from the same recipe.

    Args:
        original: Manifest of the dataset.
        name: Its name, for messages.

    Raises:
        DatasetError: if the generator or the kind has changed.
    """
    current = {"generator": GENERATOR}
    stored = {"generator": original.generator}
    if original.is_drawn:
        current["recipe.version"] = original.recipe.version
        stored["recipe.version"] = original.tables.version
    if lines := differences(stored, current, ("there", "here")):
        made_by = original.software.get("scenegen", "of another version")
        raise DatasetError(
            f"{name}: scenegen {__version__} would not make the same dataset again "
            f"({', '.join(lines)}); use scenegen {short_repr(made_by)}"
        )
