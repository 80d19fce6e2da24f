"""Recipes: every number that determines a dataset's content, resolved, checked, and read from
TOML."""

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim import BeamTable, GridSpec, Lidar, Pose, Sensor
from lidarsim.grid import Floats
from lidarsim.noise.chain import Noise
from lidarsim.noise.losses import Motion
from lidarsim.parameters import Checked, number, short_repr
from scenegen.base.errors import RecipeError, printable, reraise_as
from scenegen.base.files import Json
from scenegen.base.limits import (
    MAX_CANDIDATES,
    MAX_DRAWS,
    MAX_RAYS_IN_SAMPLE,
    MAX_SEARCHED,
    MAX_VOXELS,
    MAX_VOXELS_IN_FLIGHT,
)
from scenegen.worlds.flight import FlightConfig, Sees
from scenegen.worlds.kinds import find_kind
from scenegen.worlds.kinds.kind import WorldKind
from scenegen.worlds.mapping import Known, Mapper
from scenegen.worlds.tables import (
    beam_table,
    check_name,
    field_names,
    from_table,
    named_lidar,
    named_noise,
    read_toml,
    sensor_of,
)
from scenegen.worlds.traffic import KINDS, Traffic
from scenegen.worlds.traffic import VERSION as MOVERS_VERSION
from scenegen.worlds.world import AnyWorld


@dataclass(frozen=True, kw_only=True)
class Acceptance(Checked):
    """Which worlds and viewpoints are worth keeping: the paper removes "scenes with insufficient
    geometric complexity".

    Maps that are poorly seen stay: they are the task.
    """

    min_solids: float = number(1.0, minimum=0)
    """Minimum solids that reach into a world's map, averaged along its flight."""
    min_occupied_share: float = number(0.0005, minimum=0, maximum=1)
    """Minimum share of occupied voxels of a viewpoint's map."""
    min_returned_share: float = number(0.01, minimum=0, maximum=1)
    """Minimum share of a viewpoint's rays that return."""
    max_draws: int = number(50, minimum=1, maximum=MAX_DRAWS)
    """Draws of one world after which generation gives up."""


@dataclass(frozen=True, kw_only=True)
class NoiseConfig(Checked):
    """A recipe's [noise]."""

    stages: str = ""
    """Stages of noise, as the option --noise takes them: ``range:0.02,dropout:0.05``; none for
    clean ranges."""


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Everything that determines a dataset's content, except the seed and the counts.

    Raises ValueError, naming the table, if flights have no room in the world, or if parameters that
    are valid by themselves together need more memory or time than `scenegen.base.limits` allows."""

    kind: str
    """Name of a kind of world, a user's own as ``module:Class``, or ``scene`` for worlds from MJCF
    files."""
    difficulty: str = "medium"
    """Which of the kind's presets `world` began as."""
    world: WorldKind | None = None
    """How worlds are drawn; None for worlds from MJCF files."""
    flight: FlightConfig = field(default_factory=FlightConfig)
    accept: Acceptance = field(default_factory=Acceptance)
    lidar: Sensor = field(default_factory=Lidar)
    """The sensor. Unless it is a raster, it becomes the table of its rays, which does not need the
    user's code."""
    grid: GridSpec = field(default_factory=GridSpec)
    noise: Noise = field(default_factory=Noise)
    """The noise of ranges. Worlds, flights and viewpoints do not depend on it."""
    # a dict has no hash, and a recipe must have one to be a key
    parts: Mapping[str, Any] = field(default_factory=dict, hash=False)
    """Settings of optional parts of samples, by their names in `scenegen.draw.parts.PARTS`. Nothing
    else depends on them."""
    mapping: Mapper = field(default_factory=Mapper)
    """Which scans make a map, how the sensor is held, and where the map lies."""
    known: Known | None = None
    """How much must be known of the maps of real places; None where no world is one."""

    def __post_init__(self) -> None:
        if any(getattr(self.lidar, "lever_arm_m", ())):
            raise ValueError(
                "[lidar] lever_arm_m: a dataset's poses are the sensor's own; leave it out"
            )
        # a manifest must be readable without the user's code
        if not isinstance(self.lidar, Lidar | BeamTable):
            object.__setattr__(self, "lidar", beam_table(self.lidar))
        # read again from a manifest, the stages must be the same ones
        if self.noise.stages and Noise.parse(self.noise.spelled()) != self.noise:
            raise ValueError(
                f"[noise] stages = {str(self.noise)[:200]!a}: a stage's values cannot stand in a "
                f"manifest"
            )
        grid, flight = self.grid, self.flight
        voxels = math.prod(grid.shape)
        if voxels > MAX_VOXELS:
            raise ValueError(
                f"[grid] shape = {list(grid.shape)}: {voxels} voxels, expected {MAX_VOXELS} at most"
            )
        # each limit bounds a product: every factor is fine by itself
        if voxels * flight.viewpoints > MAX_VOXELS_IN_FLIGHT:
            raise ValueError(
                f"[flight] viewpoints = {flight.viewpoints}: their maps are in memory together, "
                f"expected "
                f"{MAX_VOXELS_IN_FLIGHT // voxels} at most with grid.shape = {list(grid.shape)}"
            )
        # no ray would leave the voxel of its sensor
        if grid.voxel_m > self.lidar.max_range_m:
            raise ValueError(
                f"[grid] voxel_m = {grid.voxel_m}: expected at most the sensor's range, "
                f"lidar.max_range_m = {self.lidar.max_range_m}"
            )
        self.mapping.check_reach(
            grid, self.lidar.max_range_m, math.prod(self.lidar.shape), MAX_RAYS_IN_SAMPLE
        )
        if self.accept.max_draws * flight.flights_per_world * flight.iterations > MAX_SEARCHED:
            raise ValueError(
                f"[accept] max_draws = {self.accept.max_draws}: times flight.flights_per_world = "
                f"{flight.flights_per_world} and flight.iterations = {flight.iterations}, "
                f"expected {MAX_SEARCHED} at most; lower one of them"
            )
        if self.world is not None:
            box = flight.bounds(self.world.size_m)
            # ten diagonals: a flight made of straight steps towards random points hardly ever takes
            # two
            candidates = 10 * float(np.sqrt(((box[1] - box[0]) ** 2).sum())) / flight.spacing_m
            if candidates > MAX_CANDIDATES:
                raise ValueError(
                    f"[flight] spacing_m = {flight.spacing_m}: {candidates:.3g} places to scan "
                    f"from along one flight, expected {MAX_CANDIDATES} at most; raise it"
                )

        if self.traffic is not None:
            self._check_movers(self.traffic)

    def _check_movers(self, traffic: Traffic) -> None:
        """Raise ValueError if movers do not go with other settings."""
        if (labels := self.parts.get("labels")) is not None:
            # movers have classes that no geom of the world names
            missing = (name for name in KINDS if name not in labels.classes)
            labels = replace(labels, classes=(*labels.classes, *missing))
            object.__setattr__(self, "parts", {**self.parts, "labels": labels})
        if traffic.firing_times and not self.scan_s:
            raise ValueError(
                "[movers] firing_times: this sensor's rays have no times of their own; give "
                "another --lidar, or leave firing_times out"
            )
        # motion casts rays anew in groups, each at one time, not at the times of its rays
        if traffic.firing_times and any(isinstance(stage, Motion) for stage in self.noise.stages):
            raise ValueError(
                "[movers] firing_times: do not go with the noise motion; leave one of the two out"
            )

    def check_splits(self, splits: Iterable[str]) -> None:
        """Check that the kind's worlds may be in these splits.

        Args:
            splits: Names of splits.

        Raises:
            RecipeError: If the kind is for testing alone, and a split is another than "test".
        """
        alone = self.world is not None and not self.world.for_training
        if alone and (others := set(splits) - {"test"}):
            raise RecipeError(
                f"kind {self.kind} is for testing alone, and has no {' or '.join(sorted(others))} "
                'split; draw samples of its test split (--test, or split="test")'
            )

    def mover_zones(self, bounds: Floats) -> dict[str, list[Floats]]:
        """Return where movers belong; see `WorldKind.mover_zones`. Files do not say where vehicles
        drive, so their worlds have none.

        Args:
            bounds: (2, 3): the box in which the sensor flies, metres.
        """
        if self.world is None:
            return {"person": [bounds], "drone": [bounds]}
        return self.world.mover_zones(bounds)

    @property
    def traffic(self) -> Traffic | None:
        """The settings of movers; None where nothing moves."""
        return self.parts.get("movers")

    @property
    def scan_s(self) -> float:
        """How long movers move during a scan, seconds."""
        timed = self.traffic is not None and self.traffic.firing_times
        return float(self.lidar.times_s.max()) if timed else 0.0

    def sees(self, world: AnyWorld) -> Sees | None:
        """Tell where enough of a map is known to scan, by a level sensor; None where all is."""
        if (known := self.known) is None:
            return None
        return lambda point: world.is_known(Pose.facing(point, (1.0, 0.0)), self.lidar, known)

    @property
    def version(self) -> int:
        """The version of the kind's preset, or of flights in maps, or 0 for worlds from MJCF files;
        plus that of movers, where there are some."""
        drawn = int(self.known is not None) if self.world is None else self.world.version
        return drawn + (MOVERS_VERSION if self.traffic else 0)

    def resolved(self) -> Json:
        """Return the manifest's `recipe`: all but sensor, noise, grid and mapping, as plain JSON
        values."""
        tables = {"world": self.world, "flight": self.flight, "accept": self.accept}
        return {
            "version": self.version,
            # left out where it is the usual one, as in manifests that were made without it
            **({} if self.difficulty == "medium" else {"difficulty": self.difficulty}),
            **{name: asdict(part) for name, part in tables.items() if part is not None},
        }


def preset(
    kind: str,
    *,
    lidar: Sensor | str | None = None,
    noise: str | None = None,
    mapping: Mapping[str, Any] | None = None,
    difficulty: str | None = None,
) -> Recipe:
    """Make the preset recipe of a kind.

    Args:
        kind: Its name, or "module:Class".
        lidar: A sensor, the name of one, such as "livox-avia", or of a TOML file of one, instead of
            the paper's.
        noise: Stages of noise, such as "range:0.02".
        mapping: Parameters of how maps are made.
        difficulty: "easy", "medium" or "hard"; medium by default.

    Returns:
        The recipe.

    Raises:
        RecipeError: If an argument is invalid; for an unknown kind, the nearest name is suggested.
    """
    return make_recipe(kind, {}, lidar=lidar, noise=noise, mapping=mapping, difficulty=difficulty)


def read_recipe(path: Path, kind: str | None = None, **settings: Any) -> Recipe:
    """Read a recipe from a TOML file.

    It has `kind`, `difficulty`, and tables [world], [flight], [accept], [lidar], [noise],
    [mapping], [known], [movers] and [grid] of values that differ from the preset. A sensor of the
    user's own is imported, so look at the `[lidar] sensor` of a stranger's recipe before you run
    it.

    Args:
        path: The file.
        kind: Replaces a missing `kind`.
        settings: As for `preset`; must not repeat the file's.

    Returns:
        The recipe.

    Raises:
        RecipeError: If the file is invalid; the message names file, table and parameter.
    """
    where = printable(path)
    tables = read_toml(path)
    named = tables.pop("kind", kind)
    if named is None:
        raise RecipeError(
            f'{where}: names no kind; add a line such as kind = "pillar", or give --kind'
        )
    if kind is not None and kind != named:
        raise RecipeError(
            f"{where}: is a recipe for kind {short_repr(named)}, not for {kind!r}; leave one "
            "of the "
            f"two out"
        )
    if not isinstance(named, str):
        raise RecipeError(f'{where}: kind = {short_repr(named)}: expected a name, such as "pillar"')
    return make_recipe(named, tables, where=where, folder=path.parent, **settings)


def _with_options(tables: Json, where: str, options: Json) -> Json:
    """Merge a file's tables with options, see `preset`; a sensor stays as it is.

    Raises RecipeError if both have the same one."""
    options = {name: value for name, value in options.items() if value is not None}
    if "noise" in options:
        options["noise"] = {"stages": options["noise"]}
    for name in options.keys() & tables.keys():
        named = ", ".join(options[name]) if name == "mapping" else f"--{name}"
        present = name if name == "difficulty" else f"a table [{name}]"
        raise RecipeError(
            f"{where}: has {present}, and {named} is given beside it; leave one of the two out"
        )
    return {**tables, **options}


def _graded(kind: type[WorldKind], level: Any, prefix: str) -> Json:
    """Return the parameters in which a kind's preset of this difficulty differs from its
    defaults."""
    known = {**kind.graded, "medium": {}}
    if not isinstance(level, str) or level not in known:
        raise RecipeError(
            f"{prefix}difficulty = {short_repr(level)}: expected one of {', '.join(known)}"
        )
    return known[level]


def _check_graded(kind: type[WorldKind], level: str, world: WorldKind, prefix: str) -> None:
    """Raise RecipeError if `world` has more values of another preset than of `level`'s.

    Only the parameters in which the kind's presets differ are counted."""
    levels = {"medium": {}, **kind.graded}
    names = sorted({name for values in levels.values() for name in values})
    alike = {}
    for preset_level, values in levels.items():
        # made as `world` was: checks turn values into the annotated types
        preset_world = from_table(kind, values, f"{prefix}difficulty {preset_level}", Path())
        alike[preset_level] = sum(
            getattr(world, name) == getattr(preset_world, name) for name in names
        )
    nearest = max(alike, key=lambda preset_level: alike[preset_level])
    if alike[level] < alike[nearest]:
        raise RecipeError(
            f"{prefix}difficulty = {short_repr(level)}: [world] has {alike[nearest]} of the "
            "values of "
            f"the {nearest} preset and {alike[level]} of that one ({', '.join(names)}); "
            "leave one of the two out"
        )


def make_recipe(
    kind: str,
    tables: Json,
    *,
    where: str = "",
    folder: Path = Path(),
    **settings: Any,
) -> Recipe:
    """Make the preset of `kind` with other values.

    The modules of a user's own kind and sensor are imported, so neither name may come from a
    stranger's file.

    Args:
        kind: Its name, or "module:Class", or "scene".
        tables: Values by table, as in a recipe's file.
        where: The tables' source, for messages.
        folder: Paths in `tables` are relative to it.
        settings: As for `preset`.

    Returns:
        The recipe.

    Raises:
        RecipeError: If a value is invalid; the message names the table and the parameter.
    """
    # `NoiseConfig`, not `Noise`: the stages stay a text until the sensor is known
    kinds = {
        "flight": FlightConfig,
        "accept": Acceptance,
        "lidar": Lidar,
        "grid": GridSpec,
        "noise": NoiseConfig,
        "mapping": Mapper,
    }
    # these two only where they are asked for: without them, recipes have None
    if "known" in tables:
        kinds["known"] = Known
    if "movers" in tables:
        kinds["movers"] = Traffic
    prefix = f"{where}: " if where else ""
    # a new table: entries are taken out of it, and the caller keeps theirs whole
    tables = _with_options(tables, where, settings)
    level = tables.pop("difficulty", "medium")
    defaults: dict[str, Json] = {}
    if kind != "scene":
        with reraise_as(RecipeError, prefix):
            world = find_kind(kind)
        kinds["world"] = world
        defaults = {"flight": world.flight_defaults, "accept": world.accept_defaults}
        defaults["world"] = _graded(world, level, prefix)
    elif level != "medium":
        raise RecipeError(f"{prefix}difficulty: worlds from MJCF files have none; leave it out")
    sensor = settings.get("lidar")
    if sensor is not None:
        sensor, tables["lidar"] = named_lidar(sensor), {}
    for name, table in tables.items():
        owners = [f"[{part}]" for part, owner in kinds.items() if name in field_names(owner)]
        # TOML puts a key behind a table's line into that table, and one before it into none
        if owners and name not in kinds and not isinstance(table, dict):
            raise RecipeError(
                f"{prefix}{name} stands in no table; "
                f"expected it below the line {' or '.join(owners)}"
            )
        check_name(name, tuple(sorted(kinds)), "table", where)
        if not isinstance(table, dict):
            raise RecipeError(
                f"{prefix}{name} = {short_repr(table)}: expected a table, [{name}], of parameters"
            )
    # the user's values come last, and win
    values = {name: defaults.get(name, {}) | tables.get(name, {}) for name in kinds}
    lidar = values.pop("lidar")
    parts = {
        name: from_table(kinds[name], table, f"{prefix}[{name}]", folder)
        for name, table in values.items()
    }
    if "movers" in parts:
        parts["parts"] = {"movers": parts.pop("movers")}
    if kind != "scene" and level != "medium":
        _check_graded(world, level, parts["world"], prefix)
    if sensor is None:
        sensor = sensor_of(lidar, f"{prefix}[lidar]", folder)
    # after the sensor: `datasheet` stands for the sensor's own noise
    noise = named_noise(parts["noise"].stages or None, sensor, prefix and f"{prefix}[noise]")
    parts |= {"lidar": sensor, "noise": noise}
    reason = f"{prefix}[world] of kind {kind}: a parameter cannot stand in a manifest: "
    with reraise_as(RecipeError, prefix), reraise_as(RecipeError, reason, of=TypeError):
        recipe = Recipe(kind=kind, difficulty=level, **parts)
        # a user's own parameters may be of any type
        json.dumps(recipe.resolved())
    return recipe
