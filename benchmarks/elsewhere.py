"""The bundled networks where they were never trained: other sensors, noise, and other worlds.

    python benchmarks/elsewhere.py MAPS                           # docs/results/elsewhere.md
    python benchmarks/elsewhere.py --maps 5 --figures /tmp/try.csv    # a quick look

MAPS is the folder of maps of real places that `real.py` takes; their flights are those of
`real.py`, and they have a part in the first table alone.

Worlds are drawn and flown once; every sensor sees them again from the same poses (`scenegen
generate --like`), so that its rows are pairs, map by map, with those of the sensor of training.
Exported networks (`scenegen export columns -o columns.onnx`, then `--network columns.onnx`) take a
fifth of the time.
"""

import tempfile
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import measuring
import numpy as np
import scoring
from real import POSES, real_places
from scoring import CAREFUL, RESULTS, Results, ahead, measured, titled, told
from tyro.conf import Positional

from lidarsim.sensors import SENSORS
from lidarsim.solids import BOX, CYLINDER
from scenegen import Dataset, Sample, WorldKind, preset
from scenegen.dataset.build import build
from scenegen.dataset.like import plan_like
from scenegen.model.bench.methods import rows_of
from scenegen.model.bench.metrics import PLAN_METRICS
from scenegen.model.bench.run import DatasetResult
from scenegen.model.config import PlanConfig, bundled
from scenegen.worlds.drawing import Drawing
from scenegen.worlds.kinds.kind import Range, yaw_quaternion
from scenegen.worlds.tables import named_noise

WORLDS = {
    "pillar": "pillar",
    "geometric": "geometric",
    "scaffold": "elsewhere:Scaffold",
    "scenes": "scene",
}
"""Two kinds of training, drawn anew; a kind of no training; worlds drawn by hand: presets."""
HOME = ("pillar", "geometric")
AWAY = "everything away from home"
OTHERS = (
    "default range:0.05",
    "default dropout:0.1",
    "ouster-os1-64",
    "ouster-os1-64 datasheet,dropout:0.05",
    "livox-mid-360",
    "realsense-d435",
    "realsense-d435 datasheet",
)
"""Sensors and noise that are not those of training."""
SEEN = (
    "observed voxels",
    "of these not occupied",
    "unknown voxels",
    "occupied voxels taken for free",
)


@dataclass(frozen=True, kw_only=True)
class Scaffold(WorldKind):
    """Thin beams, level and crossing, at any height on slender posts: hardly a solid like those of
    the presets."""

    version = 1
    crowded_by = ("beam_density",)
    flight_defaults: ClassVar = {"altitude_m": (2.0, 5.0)}

    ground: bool = True
    beam_density: Range = (0.03, 0.10)
    """Beams per square metre; one value a world. Every beam has two posts."""
    half_length_m: Range = (1.5, 5.0)
    """Half of a beam's length, metres."""
    half_edge_m: Range = (0.1, 0.3)
    """Half of the edges of a beam's cross-section, metres."""

    def add_to(self, spec: Drawing, *, rng: np.random.Generator) -> None:
        """See `WorldKind.add_to`."""
        self.add_ground(spec)
        count = round(rng.uniform(*self.beam_density) * self.size_m[0] * self.size_m[1])
        low, high = (0.0, 0.0, 0.5, 0.0), (*self.size_m[:2], 8.0, np.pi)
        x, y, z, yaw = rng.uniform(low, high, (count, 4)).T
        spans = (self.half_length_m, self.half_edge_m, self.half_edge_m)
        half = np.stack([rng.uniform(*span, count) for span in spans], axis=1)
        middle = np.stack([x, y, z], axis=1)
        spec.add_geoms(np.full(count, BOX), half, middle, yaw_quaternion(yaw))
        post = np.stack([np.full(count, 0.08), z / 2, np.zeros(count)], axis=1)
        along = half[:, :1] * np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
        for end in (-0.9, 0.9):
            foot = np.column_stack([middle[:, :2] + end * along, z / 2])
            spec.add_geoms(np.full(count, CYLINDER), post, foot)


PLANNERS = {"careful": CAREFUL, "the paper's": PlanConfig()}


class Options(scoring.Options):
    """Those of `scoring`, and what is looked at."""

    real: Positional[Path | None] = None
    """folder of the maps of real places"""
    network: Sequence[str] = tuple(bundled())


def main() -> None:
    """Make the datasets, measure, and write."""
    given = measuring.parse(Options, maps=5, trials=5, network=["columns"])
    methods = rows_of(["returns", "extrude"], given.network)
    lines: list[str] = []
    found: dict[str, dict[str, Results]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        drawn = ["scaffold"] if given.smoke else [*WORLDS]
        places = {worlds: as_seen(worlds, folder, given) for worlds in drawn}
        real = real_places(given.real, folder, min(given.maps, POSES))
        places |= {place: {"default": dataset} for place, dataset in real.items()}
        for place, seen in places.items():
            found[place] = {
                planner: measured(seen, methods, given.trials, plan)
                for planner, plan in PLANNERS.items()
            }
            if place in WORLDS:
                lines += tables(place, seen, found[place])
    scoring.publish(given, [*pooled(found), *lines])


def as_seen(worlds: str, folder: Path, given: Options) -> dict[str, Dataset]:
    """Test maps of `worlds` by sensor, all from the same poses."""
    files = RESULTS.parents[1] / "scenes" if worlds == "scenes" else None
    original = scoring.drawn(folder / worlds, preset(WORLDS[worlds]), given.maps, scenes=files)
    found = {"default": original}
    for name in OTHERS[: 1 if given.smoke else None]:
        sensor, _, noise = name.partition(" ")
        place = folder / f"{worlds} {name.replace(':', '')}"
        lidar = None if sensor == "default" else SENSORS.find(sensor)
        chain = named_noise(noise or None, lidar or original.lidar)
        build(plan_like(original.folder, place, lidar=lidar, noise=chain))
        found[name] = Dataset(place)
    return found


def pooled(found: Mapping[str, Mapping[str, Results]]) -> list[str]:
    """By how much planning succeeds oftener than with `extrude`, in several places together."""
    pairs = defaultdict(list)
    for worlds, planners in found.items():
        for planner, results in planners.items():
            for sensor, one in results.items():
                groups = [f"{worlds} {world}" for world in one.trial_worlds]
                seen = "as in training" if sensor == "default" else "other sensors and noise"
                if worlds in HOME:
                    places = [f"`pillar` and `geometric`, {seen}"]
                elif worlds in WORLDS:
                    places = [f"{worlds}, all sensors", "both, all sensors", AWAY]
                else:
                    places = ["real places", AWAY]
                for place in places:
                    pairs[f"{place}; {planner}"].append((one, groups))
    rows = {place: ahead(some, "extrude") for place, some in sorted(pairs.items())}
    names = next(iter(rows.values()))
    cells = ((place, row.values()) for place, row in rows.items())
    return titled("## Success of planning, less that of `extrude`", names, cells)


def tables(worlds: str, seen: Mapping[str, Dataset], found: Mapping[str, Results]) -> list[str]:
    """The tables of a kind of worlds: what was seen, then what was made of it."""
    results, careful = found["the paper's"], found["careful"]
    flight = flights(next(iter(seen.values())))
    names = list(next(iter(results.values())).methods)

    def groups(result: DatasetResult, metric: str) -> Any:
        return result.trial_worlds if metric in PLAN_METRICS else flight

    form: Any = {"groups": groups, "form": ".2f"}
    unknown = {
        "iou": "IoU over unknown voxels:",
        "near_rmse": "Near-RMSE over unknown voxels, m:",
    }
    shares = ((sensor, what_is_seen(dataset)) for sensor, dataset in seen.items())
    return [
        *("", f"## {worlds}", *titled("What the sensors see, means over maps:", SEEN, shares)),
        *scoring.tables(unknown, results, names, **form, region=1),
        *scoring.tables({"iou": "IoU over the whole map:"}, results, names, **form),
        *lost(results, names, flight),
        *scoring.tables({"success": "Success of planning:"}, results, names, **form),
        *scoring.tables({"success": "Success of the careful planner:"}, careful, names, **form),
    ]


def lost(results: Results, names: list[str], flight: list[str]) -> list[str]:
    """How much IoU over the whole map each sensor costs, map by map."""
    (_, usual), *others = (
        (sensor, np.array([result.methods[name].values("iou") for name in names]))
        for sensor, result in results.items()
    )
    rows = ((sensor, [told(gone, flight, ".2f") for gone in usual - now]) for sensor, now in others)
    return titled("IoU over the whole map lost against the sensor of training:", names, rows)


def flights(dataset: Dataset) -> list[str]:
    """The flight of every sample: what intervals draw again. A drawn world has one; a scene has
    several. Whatever sensor sees the worlds, samples have the same flights."""
    each = dataset.manifest.recipe.flight.viewpoints
    return [f"{one.world} {one.viewpoint // each}" for one in dataset.split("test")]


def what_is_seen(dataset: Dataset) -> list[str]:
    """See `SEEN`: the means over a dataset's maps."""
    count, *shares = np.mean([seen_of(sample) for sample in dataset.split("test")], axis=0)
    return [f"{count:.0f}", *(f"{share:.1%}" for share in shares)]


def seen_of(sample: Sample) -> tuple[float, ...]:
    """See `SEEN`."""
    observed, occupied, free = sample.observed, sample.occupancy, sample.free
    return (
        observed.sum(),
        (observed & ~occupied).sum() / max(observed.sum(), 1),
        (~(observed | free)).mean(),
        (free & occupied).sum() / max(occupied.sum(), 1),
    )


if __name__ == "__main__":
    main()
