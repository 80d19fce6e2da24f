"""A dataset scanned again: the worlds and poses of one that is there, seen by another sensor, or
with other noise."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim import Pose, Sensor
from lidarsim.engines import ENGINES, EngineFactory
from lidarsim.noise.chain import Noise
from scenegen import GENERATOR
from scenegen.dataset import manifest
from scenegen.dataset.build import divide
from scenegen.dataset.parts import NAMES, entries, schema_of
from scenegen.dataset.read import Dataset
from scenegen.dataset.shard import ShardSpec, find_engine
from scenegen.dataset.state import Plan
from scenegen.draw import (
    FLIGHT,
    Unit,
    UnitKey,
    none_rejected,
    samples_of,
    scans_from,
    truth_of,
)
from scenegen.errors import DatasetError, GenerationError, raised_as, short
from scenegen.files import real_path
from scenegen.recipe import Recipe
from scenegen.run.software import software
from scenegen.source import Source
from scenegen.stores import Place
from scenegen.worlds.flight import fly, viewpoints
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
class RescanSpec(ShardSpec):
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


def plan_rescan(
    dataset: Dataset,
    folder: Place,
    *,
    lidar: Sensor | None = None,
    chain: Noise | None = None,
    engine: str | None = None,
    mapping: Mapping[str, Any] | None = None,
) -> Plan:
    """Plan in `folder` what `dataset` is with another sensor `lidar`, with noise by `chain`, cast
    by another `engine`, or mapped otherwise, by some parameters of a `Mapper`; what is not given
    stays, but for noise, of which there is none then. Poses are those that are stored, unless more
    earlier scans are asked for, or others: then flights are planned again, for these alone.

    Worlds, poses, counts, shards, seed and grid are the dataset's. Raises DatasetError.
    """
    original = dataset.manifest
    if original.sources:
        raise DatasetError(
            f"{dataset.folder}: its samples were made for other datasets; scan those again, and "
            f"take or merge then"
        )
    if engine is None and original.engine not in ENGINES.builtin:
        raise DatasetError(
            f"{dataset.folder}: made with the engine {short(original.engine)}, which is not "
            "imported because a manifest names it; give --engine with its name, or one of ours"
        )
    engine = engine or original.engine
    find_engine(engine)
    with raised_as(DatasetError):
        mapper = replace(original.mapping, **(mapping or {}))
        recipe = replace(
            original.recipe, lidar=lidar or original.lidar, noise=chain or Noise(), mapping=mapper
        )
    if real_path(folder) == real_path(dataset.folder):
        raise DatasetError(f"{folder}: is the dataset itself; choose another folder with --out")
    left = {name: it for name, it in original.parameters.items() if name not in (*NAMES, "engine")}
    parameters = left | {
        "generator": GENERATOR,
        "fields": list(schema_of(recipe).stored(compact="tudf" not in original.fields)),
        **entries(recipe),
        "rescan": {"digest": original.digest},
        "engine": engine,
        "software": software(),
    }
    parameters["version"] = manifest.version_of(parameters)
    return divide(folder, parameters, recipe, Archived(dataset.folder), RescanSpec)
