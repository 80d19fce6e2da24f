"""Where worlds come from: drawn by a recipe, or read from files.

A source maps a unit (one flight and its samples) to the world that it flies through.
"""

import functools
import itertools
import math
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.random import Generator

from lidarsim import Pose
from lidarsim.grid import Floats
from scenegen import SPLITS
from scenegen.base.errors import (
    CorruptFileError,
    RecipeError,
    SceneError,
    plural,
    printable,
    reraise_as,
)
from scenegen.base.files import Json, real_path
from scenegen.base.limits import (
    MAX_ARCHIVE_BYTES,
    MAX_DRAWN_M,
    MAX_GEOMS,
    MAX_MEMBERS,
    SCENE_BYTES,
    SCENE_SECONDS,
)
from scenegen.base.paths import CLOUDS, MAPS, MESHES
from scenegen.base.reading import world_digest
from scenegen.base.workers import Limited, run
from scenegen.worlds.classes import By
from scenegen.worlds.flight import (
    POINTS,
    FlightConfig,
    apart,
    around,
    heights,
    plan_flight,
    viewpoints,
)
from scenegen.worlds.labels import class_names
from scenegen.worlds.mapping import Known
from scenegen.worlds.place import Place
from scenegen.worlds.recipe import Acceptance, Recipe, make_recipe
from scenegen.worlds.scene import Reading, Scene, cut, named, read_file
from scenegen.worlds.traffic import PRESETS
from scenegen.worlds.world import (
    AnyWorld,
    World,
    archived_world,
    solid,
    with_movers,
    write_world,
)

SHARES = {"train": 10, "val": 1, "test": 2}
"""Relative numbers of worlds of each split, when the worlds of a folder are divided."""

REGIONS = {"train": 3, "val": 1, "test": 1}
"""Relative volumes of free space of each split's region, when a single map is cut."""
GAP_M = 1.0
"""Distance of regions, metres."""


class Source(Protocol):
    """Worlds by number. Sources are small and can be pickled, as they are sent to worker processes
    and clusters."""

    def number(self, split: str, unit: int) -> tuple[int, int]:
        """Find the world of a unit.

        Args:
            split: Name of the split.
            unit: Number of the unit in its split.

        Returns:
            Number of the world in its split, and how many earlier units of the split visit it.
        """
        ...

    def world(self, split: str, number: int, *, rng: Generator) -> AnyWorld:
        """Make or read a world.

        Args:
            split: Name of the split.
            number: Number of the world in its split.
            rng: Random numbers that the world is drawn by, if it is drawn.
        """
        ...

    def describe(self) -> Json:
        """Identify the source in the manifest; {} if the recipe says all."""
        return {}

    def class_names(self, by: By) -> set[str]:
        """Classes of the worlds' geoms."""
        return set()


@dataclass(frozen=True)
class DrawnWorlds(Source):
    """A new world for every unit, drawn by the recipe's kind."""

    recipe: Recipe

    def number(self, split: str, unit: int) -> tuple[int, int]:
        """Find the world of a unit; see `Source.number`.

        Returns:
            The unit's own number, and 0.
        """
        return unit, 0

    def world(self, split: str, number: int, *, rng: Generator) -> World:
        """Draw a world; see `Source.world`.

        Raises:
            RecipeError: if the kind draws a world that MuJoCo cannot compile.
        """
        kind = self.recipe.world
        if kind is None:
            raise RecipeError(
                'kind "scene" draws no worlds; give the MJCF file or folder with --scene'
            )
        bounds = self.recipe.flight.bounds(kind.size_m)
        # the fault may lie in a user's own kind, and not in the values
        advice = "correct it" if ":" in self.recipe.kind else "take values nearer to the preset's"
        with reraise_as(
            RecipeError,
            f"[world] of kind {self.recipe.kind!r} draws what cannot be: ",
            f"; {advice}",
            of=(ValueError, CorruptFileError, SceneError),
        ):
            return write_world(lambda spec: kind.add_to(spec, rng=rng), flight_bounds=bounds)

    def class_names(self, by: By) -> set[str]:
        """Classes of the worlds' geoms that the kind declares in `classes`."""
        return set(getattr(self.recipe.world, "classes", ()))


MAP_DRAWS = 500
"""Default number of draws in maps. In building 079, nine of ten draws find no flight."""


@dataclass(frozen=True)
class SceneWorlds:
    """Worlds from files: MJCF, meshes or maps. The units of a split visit its worlds in turn, so
    that samples are spread evenly over them."""

    scenes: Mapping[str, Sequence[Scene]]
    """Worlds of each split."""
    notes: tuple[str, ...] = ()
    """Sentences about parts of files that were left out or interpreted."""
    uncut: Scene | None = None
    """The map of whose regions the scenes are, if it may serve for training alone instead."""

    def number(self, split: str, unit: int) -> tuple[int, int]:
        """Find the world of a unit; see `Source.number`.

        Returns:
            Number of the world, and number of the round over all worlds.
        """
        turn, number = divmod(unit, len(self.scenes[split]))
        return number, turn

    def world(self, split: str, number: int, *, rng: Generator) -> AnyWorld:
        """Compile the world of a file; see `Source.world`. Nothing is drawn.

        Returns:
            The world.
        """
        scene = self.scenes[split][number]
        # a tuple, as arguments of a cached function need a hash
        return _compiled(scene.name, scene.mjcf, tuple(scene.assets.items()))

    def describe(self) -> Json:
        """Names and digests of the files, by split."""
        return {
            split: [
                {"file": scene.name, "sha256": world_digest(scene.mjcf, scene.assets).hex()}
                for scene in scenes
            ]
            for split, scenes in self.scenes.items()
            if scenes
        }

    def class_names(self, by: By) -> set[str]:
        """Classes of the worlds' geoms."""
        rng = np.random.default_rng(0)
        worlds = (
            self.world(split, n, rng=rng)
            for split, scenes in self.scenes.items()
            for n in range(len(scenes))
        )
        return {
            name
            for world in worlds
            for name in class_names(solid(world, "--labels: one of the worlds").model, by)
        }

    def moving(self, recipe: Recipe, seed: int) -> "SceneWorlds":
        """Add the recipe's movers to worlds without any. Several units visit a world, so its movers
        do not depend on the unit.

        Args:
            recipe: The recipe.
            seed: Seed of the dataset.

        Returns:
            Worlds with movers; the same ones if the recipe has none.

        Raises:
            SceneError: if movers find no room in a world.
        """
        if (traffic := recipe.traffic) is None:
            return self

        def moved(split: str, number: int, scene: Scene) -> Scene:
            """Add movers to one world.

            Args:
                split: Name of the split.
                number: Number of the world in its split.
                scene: The world, without movers.

            Returns:
                The world, whose document has the movers.

            Raises:
                SceneError: if they find no room.
            """
            world = self.world(split, number, rng=np.random.default_rng(seed))
            zones = recipe.mover_zones(world.flight_bounds)
            key = [seed, SPLITS.index(split), number]
            moving = with_movers(world, zones, traffic, seed=key, name=scene.name)
            return replace(scene, mjcf=moving.mjcf)

        scenes = {
            split: tuple(moved(split, n, scene) for n, scene in enumerate(scenes))
            for split, scenes in self.scenes.items()
        }
        return replace(self, scenes=scenes)

    @property
    def maps(self) -> list[str]:
        """Names of the worlds that are maps of real places."""
        return [scene.name for scenes in self.scenes.values() for scene in scenes if scene.is_map]

    def suited(self, recipe: Recipe, settled: Collection[str] = ()) -> tuple["SceneWorlds", Recipe]:
        """Adapt a recipe to maps: set `known`, allow more draws than usual, since many flights end
        at unknown space, and find altitudes, radius, length and viewpoints of
        flights.

        Args:
            recipe: The recipe.
            settled: Parameters of flights to keep.

        Returns:
            The worlds, and the recipe. A map is not cut into regions if flights do not fit in each,
            and `uncut` may serve.

        Raises:
            SceneError: if no flight fits in one of the maps.
        """
        if not self.maps:
            return self, recipe
        recipe = replace(recipe, known=recipe.known or Known())
        if recipe.accept.max_draws == Acceptance.max_draws:
            accept = replace(recipe.accept, max_draws=MAP_DRAWS)
            with suppress(ValueError):  # beyond MAX_SEARCHED: keep the recipe's draws
                recipe = replace(recipe, accept=accept)
        widest: Json = {"altitude_m": EVERYWHERE, "step_m": MAP_STEP_M}
        widest = {name: value for name, value in widest.items() if name not in settled}
        recipe = replace(recipe, flight=replace(recipe.flight, **widest))
        try:
            fits = [_fit(*named, recipe, settled) for named in self._places()]
        except SceneError as error:
            if self.uncut is None:
                raise
            note = f"{self.uncut.name}: all of it is for training: {error}"
            return _trained_on(self.uncut, (*self.notes, note)).suited(recipe, settled)
        low, high = zip(*(flight.altitude_m for flight in fits), strict=True)
        flight = replace(
            recipe.flight,
            altitude_m=(min(low), max(high)),
            # one recipe serves all maps: what fits in the narrowest fits in each
            robot_radius_m=min(flight.robot_radius_m for flight in fits),
            min_distance_m=min(flight.min_distance_m for flight in fits),
            viewpoints=min(flight.viewpoints for flight in fits),
        )
        return self, replace(recipe, flight=flight)

    def _places(self) -> Iterator[tuple[Place, str]]:
        """The maps, and their names for messages."""
        rng, is_cut = np.random.default_rng(0), len(set(self.maps)) < len(self.maps)
        for split, scenes in self.scenes.items():
            for number, scene in enumerate(scenes):
                if scene.is_map:
                    place: Any = self.world(split, number, rng=rng)
                    yield place, f"{scene.name}{f' ({split})' * is_cut}"


EVERYWHERE = (-MAX_DRAWN_M, MAX_DRAWN_M)
"""Altitudes of flights in maps, before they are found."""
MAP_STEP_M = 0.5
"""Default of `step_m` in maps, which are denser than drawn worlds, metres."""
STARTS = 40
"""Number of starts in a map from which the widest way is searched."""
WIDE_SHARE = 0.1
"""A robot fits in a map if this share of starts has a way as wide as it."""
RADII, NARROWER = 4, 0.75
"""Number of radii that are tried, and the ratio of one to the one before."""
FLIGHTS, ENOUGH = 20, 2
"""Flights tried, and how many of them must have enough known viewpoints."""
SEEN_SHARE = 0.1
"""The value of `most_marked_share` that a message names admits this share of free points."""


def _fit(place: Place, name: str, recipe: Recipe, settled: Collection[str]) -> FlightConfig:
    """Find altitudes, radius, length and viewpoints of flights in a map, from points that are free
    and known.

    Args:
        place: The map.
        name: Its name, for messages.
        recipe: Bounds of both.
        settled: Parameters of flights to keep.

    Returns:
        The recipe's flights with these.

    Raises:
        SceneError: if nothing fits; it says which value would.
    """
    flight, known = recipe.flight, recipe.known or Known()
    box, bounds = heights(place, flight), place.flight_bounds[:, 2].tolist()
    if not box[0, 2] < box[1, 2]:
        raise SceneError(
            f"flight.altitude_m = {list(flight.altitude_m)}: {name} is not free there; {bounds} "
            "would do"
        )
    # a fixed seed: the same map gives the same flights, whatever the dataset's seed
    drawn = np.random.default_rng(0).uniform(box[0], box[1], (POINTS, 3))
    points = [point for point in drawn if place.clearance.at(*point) > 0.0]
    if not points:
        raise SceneError(f"{name}: hardly any of it is free between {box[0, 2]} and {box[1, 2]} m")

    def admitted(share: float) -> list[Floats]:
        return list(
            filter(
                replace(recipe, known=replace(known, most_marked_share=share)).sees(place), points
            )
        )

    if not (starts := admitted(known.most_marked_share)):
        shares = np.arange(known.most_marked_share, 1.0, 0.05)[1:].round(2).tolist()
        would = next((s for s in shares if len(admitted(s)) >= SEEN_SHARE * len(points)), 1.0)
        raise SceneError(
            f"known.most_marked_share = {known.most_marked_share:g} leaves no place to scan from "
            f"in {name}; {would:g} would"
        )
    heights_m, radius_m = np.array(starts)[:, 2], flight.robot_radius_m
    band = math.floor(10 * heights_m.min()) / 10, math.ceil(10 * heights_m.max()) / 10
    flight = replace(flight, altitude_m=flight.altitude_m if "altitude_m" in settled else band)
    widths = [
        place.clearance.width_m(start, apart(around(box, start, flight), flight), radius_m)
        for start in starts[:STARTS]
    ]
    keeps = "robot_radius_m" in settled
    wide_m = float(np.quantile(widths, 1 - WIDE_SHARE))
    # rounded down, to what a person would write; 1e-9, as 100 * 0.29 is a little less than 29
    radii_m = [math.floor(100 * wide_m * NARROWER**n + 1e-9) / 100 for n in range(RADII)]
    if keeps and radius_m <= max(widths):
        radii_m = [radius_m, *(smaller for smaller in radii_m if smaller < radius_m)]
    scans_m = flight.viewpoints * flight.spacing_m
    distances_m = {flight.min_distance_m}
    if "min_distance_m" not in settled:
        distances_m.add(min(scans_m, flight.min_distance_m))
    most, best = 0, flight
    # wide robots first, then long flights: the first that fits is taken
    for tried_m, distance_m in itertools.product(filter(None, radii_m), sorted(distances_m)[::-1]):
        tried = replace(flight, robot_radius_m=tried_m, min_distance_m=distance_m)
        scans = _most_scans(place, replace(recipe, flight=tried))
        if scans >= flight.viewpoints:
            if keeps and tried_m != radius_m:
                raise SceneError(
                    f"flight.robot_radius_m = {radius_m:g} fits nowhere in {name}; {tried_m:g} "
                    "would"
                )
            return tried
        if scans > most:
            most, best = scans, replace(tried, viewpoints=scans)
    if most > 1 and "viewpoints" not in settled and not keeps:
        return best
    would = f"{most} would" if most else "lower flight.min_distance_m, or scan from more places"
    raise SceneError(f"flight.viewpoints = {flight.viewpoints} fits nowhere in {name}; {would}")


def _most_scans(place: Place, recipe: Recipe) -> int:
    """Count the known viewpoints of flights: so many have `ENOUGH` of those that are tried, or
    more."""
    flight, known, rng = recipe.flight, recipe.known or Known(), np.random.default_rng(0)
    counts = [0] * ENOUGH
    for _ in range(FLIGHTS):
        path = plan_flight(place, flight, rng=rng, sees=recipe.sees(place))
        if path is not None:
            route, flown = viewpoints(path, flight.spacing_m, rng=rng)
            accepted = list[Floats]()
            for pose in (route.pose(metres, recipe.mapping) for metres in flown):
                # the spacing as in `draw`: without it, rooms that are too small would pass
                gaps = [((pose.position - other) ** 2).sum() for other in accepted]
                if min(gaps, default=math.inf) >= flight.spacing_m**2 and _is_known(
                    place, pose, recipe, known
                ):
                    accepted.append(pose.position)
            counts.append(len(accepted))
        if (most := sorted(counts)[-ENOUGH]) >= flight.viewpoints:
            break
    return most


def _is_known(place: Place, pose: Pose, recipe: Recipe, known: Known) -> bool:
    """Tell whether enough of a map is known at a viewpoint."""
    if not place.is_known(pose, recipe.lidar, known):
        return False
    truth = place.truth(recipe.grid, recipe.mapping.origin(recipe.grid, pose))
    return "known" not in truth or bool(truth["known"].mean() >= known.least_share)


def _trained_on(scene: Scene, notes: tuple[str, ...]) -> SceneWorlds:
    """A single world, for training."""
    return SceneWorlds({**dict.fromkeys(SPLITS, ()), "train": (scene,)}, notes)


def read_world(path: str | Path, report: Callable[[str], None] | None = None) -> AnyWorld:
    """Read a world from an MJCF file, a mesh, or a map of a real place.

    Args:
        path: The file.
        report: Called with each note about the file.

    Raises:
        SceneError: if the file cannot be used.
    """
    if Path(path).is_dir():
        raise SceneError(f"{path}: is a folder; expected one MJCF file, or a map")
    source = read_scenes(Path(path), {"train": 1, "val": 0, "test": 0}, seed=0, allow_unseen=True)
    if report:
        for line in source.notes:
            report(line)
    return source.world("train", 0, rng=np.random.default_rng(0))


def named_world(
    name: str,
    seed: int,
    difficulty: str | None = None,
    report: Callable[[str], None] | None = None,
    movers: str | None = None,
    tables: Json | None = None,
) -> AnyWorld:
    """Read a world from a file, or draw one of a kind.

    Args:
        name: Path of a file, or name of a kind.
        seed: Seed of a drawn world.
        difficulty: "easy", "medium" or "hard".
        report: Called with each note about a file.
        movers: Preset of movers, see `scenegen.worlds.traffic.PRESETS`; a file's own are kept.
        tables: Values of a kind's recipe that differ from its preset, by table and name.

    Raises:
        SceneError: if the file cannot be used, or movers find no room.
        RecipeError: if there is no such kind.
    """
    is_file = Path(name).exists() or (":" not in name and not name.isidentifier())
    recipe = make_recipe("scene" if is_file else name, tables or {}, difficulty=difficulty)
    world: AnyWorld
    if is_file:
        world = read_world(name, report)
    else:
        world = DrawnWorlds(recipe).world("train", 0, rng=np.random.default_rng(seed))
    if movers is None:
        return world
    zones = recipe.mover_zones(world.flight_bounds)
    return with_movers(world, zones, PRESETS[movers], seed=[seed], name=name)


@functools.lru_cache(maxsize=8)  # the units of a split return to the same worlds
def _compiled(name: str, mjcf: bytes, assets: tuple[tuple[str, bytes], ...]) -> AnyWorld:
    return archived_world(mjcf, dict(assets), name=name)


def read_scenes(
    path: Path,
    counts: Mapping[str, int | None],
    *,
    seed: int,
    allow_unseen: bool = False,
    materials: bool = False,
    voxel_m: float = 0.0,
) -> SceneWorlds:
    """Read worlds from files, and divide them among the splits by `SHARES`. A single map is cut
    into regions, by `REGIONS`.

    The division depends only on the names of the files, the seed, and which splits are not empty.
    It does not depend on the number of samples.

    Args:
        path: An MJCF file, a mesh, a map of a real place, a folder of these, or a point cloud.
        counts: Number of samples of each split; None for a default if there are several worlds, or
            regions.
        seed: Seed of the division.
        allow_unseen: Whether worlds may have geoms that rays cannot see.
        materials: Whether worlds keep the names of their materials.
        voxel_m: Edge of a sample's voxel, metres; regions are at least this far apart.

    Raises:
        SceneError: if a file cannot be used, two are the same world, or there are fewer worlds than
            splits.
    """
    if not path.exists():
        raise SceneError(f"{path}: no such file or folder; expected MJCF, or a map")
    # sorted: the division must not depend on the order of the file system
    files = sorted(world_files(path)) if path.is_dir() else [path]
    scenes, part_files = _read_files(files, materials)
    if not scenes:
        raise SceneError(
            f"{path}: holds no world, or parts alone, which other files include; expected MJCF, "
            "meshes or maps (scenegen map makes one of point clouds)"
        )
    _check(scenes, allow_unseen)
    notes = (
        [f"{path}: {named(part_files)} left out: parts, which other files include"]
        if part_files
        else []
    )
    notes += [note for scene in scenes.values() for note in scene.notes]
    lone = next(iter(scenes.values())) if len(scenes) == 1 else None
    # a single map serves several splits, as it can be cut
    several = lone is None or lone.is_map
    splits = [split for split in SPLITS if (several if counts[split] is None else counts[split])]
    if lone is not None and lone.is_map and len(splits) > 1:
        worlds: dict[str, tuple[Scene, ...]] = dict.fromkeys(SPLITS, ())
        # at least a voxel apart, so that no voxel of a sample reaches into two splits
        regions = cut(lone, [REGIONS[split] for split in splits], max(GAP_M, voxel_m))
        worlds |= {split: (region,) for split, region in zip(splits, regions, strict=True)}
        # who asks for samples of val or test needs the regions
        return SceneWorlds(worlds, tuple(notes), None if counts["val"] or counts["test"] else lone)
    if len(scenes) < len(splits):
        raise SceneError(
            f"{path}: {plural(len(scenes), 'worlds')} for {len(splits)} splits, and no two splits "
            "share one; add worlds, or set --val and --test to 0 and measure on the training "
            "samples (bench --split train)"
        )
    order = np.random.default_rng(seed).permutation(len(scenes)).tolist()
    total_share = sum(SHARES[split] for split in splits)
    sizes = {split: max(1, len(scenes) * SHARES[split] // total_share) for split in splits}
    # the first split gets the rest of the rounding
    sizes[splits[0]] = len(scenes) - sum(sizes[split] for split in splits[1:])
    by_number = list(scenes.values())
    shuffled = iter([by_number[number] for number in order])
    worlds = {split: tuple(itertools.islice(shuffled, sizes.get(split, 0))) for split in SPLITS}
    return SceneWorlds(worlds, tuple(notes))


def world_files(folder: Path) -> list[Path]:
    """Files in a folder that may be worlds: MJCF and maps. Meshes count only where there is no MJCF
    file, which might refer to them. Point clouds do not count: several may show one place."""
    files = list(folder.iterdir())
    mjcf = [path for path in files if path.suffix == ".xml"]
    endings = MAPS if mjcf else (*MAPS, *MESHES)
    return mjcf + [path for path in files if path.suffix in endings]


def _read_files(files: Sequence[Path], materials: bool) -> tuple[dict[Path, Scene], list[str]]:
    """Read worlds. Returns them by path, and the names of files that other files include.

    MJCF and meshes are read in a separate process with limits on time and memory. It costs about a
    second, as kernels are loaded twice. Maps and clouds are read in this process by code with its
    own bounds.
    """
    read = Limited(
        functools.partial(_read_alone, materials=materials),
        lambda _: SCENE_SECONDS,
        SCENE_BYTES,
        _given_up,
    )
    maps = [path for path in files if path.suffix in (*MAPS, *CLOUDS)]
    readings = [read_file(path) for path in maps]
    readings += run(read, [path for path in files if path not in maps], 1)
    # as if read one by one: the first fault by name is reported
    readings.sort(key=lambda reading: reading.path)
    included = {path for reading in readings for path in reading.includes}
    scenes, parts = dict[Path, Scene](), list[str]()
    for reading in readings:
        # an included file need not be a world by itself, so its faults do not count
        if real_path(reading.path) in included or reading.outcome is None:
            parts.append(reading.path.name)
        elif isinstance(reading.outcome, SceneError):
            raise reading.outcome
        else:
            scenes[reading.path] = reading.outcome
    return scenes, parts


def _read_alone(path: Path, *, materials: bool) -> Reading:
    """Call `read_file` in the separate process. Its standard error is closed, as Qhull prints
    there; MuJoCo's exceptions describe the fault."""
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    return read_file(path, materials=materials)


def _given_up(path: Path, reason: str) -> Reading:
    allowed = f"{SCENE_SECONDS:g} s and {SCENE_BYTES >> 30} GB"
    fault = f"{path}: reading it {reason}; {allowed} are allowed: give a simpler world, of "
    fault += f"{MAX_GEOMS} geoms at most"
    return Reading(path, SceneError(fault))


def _check(scenes: Mapping[Path, Scene], allow_unseen: bool) -> None:
    """Check worlds together. Raises SceneError for geoms that rays cannot see, for two files with
    the same solids, which could end in two splits, and for more files or bytes than an archive may
    hold."""
    owner, files, total_bytes = dict[bytes, Path](), set[str](), 0
    for path, scene in scenes.items():
        if scene.unseen and not allow_unseen:
            raise SceneError(
                f"{path}: rays cannot see geom {printable(named(scene.unseen))} (alpha 0); give it "
                "an alpha above 0, remove it, or pass --allow-unseen to leave it out of the truth"
            )
        first = owner.setdefault(scene.geometry, path)
        if first is not path:
            raise SceneError(
                f"{path}: the same world as {first.name}, whatever its geoms are called; remove "
                "one of the two"
            )
        total_bytes += len(scene.mjcf)
        # worlds may share files, which an archive holds once
        total_bytes += sum(len(scene.assets[name]) for name in scene.assets.keys() - files)
        files |= {path.name, *scene.assets}
        if total_bytes > MAX_ARCHIVE_BYTES or len(files) > MAX_MEMBERS:
            raise SceneError(
                f"{path.parent}: the worlds take more than {MAX_ARCHIVE_BYTES} bytes or "
                f"{MAX_MEMBERS} files; use coarser meshes, or fewer worlds"
            )
