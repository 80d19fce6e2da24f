"""`generate --like`: a dataset again by its manifest, which is its recipe, or its worlds and poses
seen by another sensor, or with other noise."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from lidarsim import Pose, Sensor
from lidarsim.engines import ENGINES, EngineFactory
from lidarsim.noise.chain import Noise
from scenegen import GENERATOR, __version__
from scenegen.base.errors import BrokenError, DatasetError, GenerationError, raised_as, short
from scenegen.base.files import Json, real_path
from scenegen.base.paths import check_type, type_of
from scenegen.base.stores import Place
from scenegen.dataset import manifest
from scenegen.dataset.build import plan_dataset, recipe_entry
from scenegen.dataset.locate import locate
from scenegen.dataset.manifest import Manifest
from scenegen.dataset.parameters import differences
from scenegen.dataset.read import Dataset
from scenegen.dataset.schema import NAME, to_json
from scenegen.dataset.shard import ShardSpec, find_engine
from scenegen.dataset.state import Plan
from scenegen.draw.draw import (
    FLIGHT,
    Unit,
    UnitKey,
    none_rejected,
    samples_of,
    scans_from,
    truth_of,
)
from scenegen.draw.source import DrawnWorlds, Source
from scenegen.worlds.flight import fly, viewpoints
from scenegen.worlds.recipe import Recipe
from scenegen.worlds.world import AnyWorld


def fly_again(
    world: AnyWorld, poses: Sequence[Pose], recipe: Recipe, key: UnitKey
) -> list[list[Pose]]:
    """The poses of the scans that the recipe's mapping asks for of samples with these `poses`, each
    its own first: the unit's flight is planned again, and known by its passing all of them, to the
    bit.

    Raises GenerationError where no draw's flight does.
    """
    for attempt in range(recipe.accept.max_draws):
        rng = key.rng(FLIGHT, attempt)
        for _ in range(recipe.flight.flights_per_world):
            path = fly(world, recipe.flight, rng=rng)
            if path is None:
                continue
            route, passed = viewpoints(path, recipe.flight.spacing_m, rng=rng)
            positions, _ = route.at(passed)
            places = [np.flatnonzero((positions == pose.position).all(axis=1)) for pose in poses]
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
    recipe: Recipe,
    key: UnitKey,
    *,
    names: tuple[int, int],
    derived: bool = True,
    engine: EngineFactory,
) -> Unit:
    """The unit whose flight through `world` had these sensor `poses`, as the recipe's sensor and
    noise see it: of each sample its own, and then those of its earlier scans, the last one first.

    `names` are the world's number and the first sample's viewpoint. Nothing is drawn but the noise,
    and nothing is rejected. With what the unit was drawn with, the same samples come out, bit for
    bit. Raises GenerationError.
    """
    caster = world.caster(engine)
    views = []
    for before in poses:
        scans = scans_from(before, caster, recipe.lidar)
        views.append((scans, truth_of(world, scans[0], recipe)))
    samples = samples_of(views, recipe, world, caster, key, names, derived)
    return Unit(names[0], world, samples, none_rejected())


@dataclass(frozen=True, eq=False)
class Archived(Source):
    """The worlds of a dataset, as a `Source`: read from its archives, and never drawn."""

    folder: Path

    @cached_property
    def dataset(self) -> Dataset:
        """The dataset, opened once a process, and checked: what comes of it would hide its
        faults."""
        return Dataset(self.folder, checked=True)

    def __getstate__(self) -> dict[str, Any]:
        return {"folder": self.folder}

    def describe(self) -> Json:
        """See `Source.describe`."""
        scenes = to_json(self.dataset.manifest)["scenes"]
        return scenes or {}

    def number(self, split: str, unit: int) -> tuple[int, int]:
        """See `Source.number`."""
        numbering = self.dataset.manifest.numbering(split)
        world, viewpoint = numbering.name(unit * numbering.viewpoints)
        return world, viewpoint // numbering.viewpoints

    def world(self, split: str, number: int, *, rng: np.random.Generator) -> AnyWorld:
        """See `Source.world`; nothing is drawn."""
        return self._world(split, number)

    @lru_cache(maxsize=8)  # noqa: B019 (flights through a world from a file share it)
    def _world(self, split: str, number: int) -> AnyWorld:
        return self.dataset.compile(split, number)


@dataclass(frozen=True)
class ScanAgain(ShardSpec):
    """A shard of a dataset that is scanned again."""

    def draw(self, unit: int) -> Unit:
        """See `ShardSpec.draw`: the unit as it was flown, scanned by the recipe's sensor and
        noise."""
        source: Any = self.source
        dataset, each = source.dataset, self.recipe.flight.viewpoints
        samples = dataset.split(self.split)[unit * each : (unit + 1) * each]
        number, turn = source.number(self.split, unit)
        world = source.world(self.split, number, rng=np.random.default_rng(0))
        key = UnitKey(self.seed, self.split, unit)
        mapping, there = self.recipe.mapping, dataset.manifest.mapping
        odd = f"{dataset.folder}: {self.split} sample: "
        with raised_as(DatasetError, odd, "; verify the dataset"):
            poses = [[scan.pose for scan in one.scans()[: mapping.scans]] for one in samples]
        if mapping.scans > there.scans or mapping.scan_spacing_m != there.scan_spacing_m:
            own = [stored[0] for stored in poses]
            poses = fly_again(world, own, self.recipe, key)
        return scan_again(
            world,
            poses,
            self.recipe,
            key,
            names=(number, turn * each),
            derived=self.derived,
            engine=find_engine(self.engine),
        )


def plan_like(
    name: str | Path,
    folder: Place,
    *,
    kind: str | None = None,
    lidar: Sensor | None = None,
    noise: Noise | None = None,
    mapping: Mapping[str, Any] | None = None,
    engine: str | None = None,
    **options: Any,
) -> Plan:
    """Plan in `folder` a dataset like another one.

    What is not given is as in that one. Where nothing is given, and its worlds were drawn, they are
    drawn again by its recipe and seed: the samples are the same, bit for bit. Else its worlds are
    scanned again from the same poses; where more earlier scans are asked for, or others, its
    flights are planned again, for these alone.

    Args:
        name: The dataset; or its manifest, where nothing but the recipe is needed.
        folder: Where the new one is to be.
        kind: The dataset's kind, where it is a user's own, so that its module may be imported.
        lidar: Another sensor.
        noise: Other noise; empty for none.
        mapping: Some parameters of a `Mapper`.
        engine: What casts the rays.
        options: Others of `plan_dataset`: `counts`, where worlds are drawn again; `compact`.

    Raises:
        DatasetError: There is no such dataset, or this scenegen would make another one.
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
            f"{name}: made with the engine {short(original.engine)}, which is not imported because "
            "a manifest names it; give --engine with its name, or one of ours"
        )
    if not original.noise_is_ours and noise is None:
        raise DatasetError(
            f"{name}: its noise, {short(original.noise_stages)}, has stages that are none of "
            "scenegen's own, which are not imported because a manifest names them; give --noise"
        )
    if odd := sorted({"tilt_mps", "settle_s", "most_tilt_deg"} & set(mapping or {})):
        raise DatasetError(
            f"{name}: its samples keep their poses, and {odd[0]} would tilt others; generate a "
            "dataset with it"
        )
    engine = engine or original.engine
    find_engine(engine)
    with raised_as(DatasetError, f"{name}: ", of=(BrokenError, ValueError)):
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
    # what worlds were drawn by stays, also where their kind is not known here
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
    """The manifest of a dataset, or in a file. Raises DatasetError."""
    folder = path.parent if path.is_file() else path
    original = manifest.load(folder)
    if kind is not None:
        if kind != original.kind:
            raise DatasetError(f"--kind {kind}: the dataset's kind is {short(original.kind)}")
        original = manifest.parse(manifest.read_content(folder), folder, kind)
    return original


def check_same(original: Manifest, name: str | Path) -> None:
    """Raise DatasetError where this scenegen draws other worlds of the same recipe."""
    here = {"generator": GENERATOR}
    stored = {"generator": original.generator}
    if original.is_drawn:
        here["recipe.version"] = original.recipe.version
        stored["recipe.version"] = original.tables.version
    if lines := differences(stored, here, ("there", "here")):
        made_by = original.software.get("scenegen", "of another version")
        raise DatasetError(
            f"{name}: scenegen {__version__} would not make the same dataset again "
            f"({', '.join(lines)}); use scenegen {short(made_by)}"
        )
