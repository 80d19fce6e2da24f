"""The bundled networks where they were never trained: other sensors, noise, and other worlds.

    python benchmarks/elsewhere.py --data /tmp/elsewhere     # makes docs/results/elsewhere.json and
    .md
    python benchmarks/elsewhere.py --maps 5 --out /tmp/try   # a quick look

Worlds are drawn and flown once; every sensor sees them again from the same poses (`scenegen
rescan`), so that its rows are pairs, map by map, with those of the sensor of training. What was
made in `--data` is used again. Exported networks (`scenegen export columns -o columns.onnx`, then
`--weights columns.onnx`) take a fifth of the time.
"""

import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import measuring
import mujoco
import numpy as np
import scoring
from scoring import RESULTS, Ahead

from lidarsim.sensors import RASTER, SENSORS
from scenegen.dataset.build import build
from scenegen.dataset.read import Dataset
from scenegen.dataset.rescan import plan_rescan
from scenegen.files import Json
from scenegen.model.completion.completer import Completer
from scenegen.model.completion.unlearned import Extrude, Returns
from scenegen.model.config import BenchConfig, PlanConfig, bundled
from scenegen.model.evaluation.methods import Completed, Method
from scenegen.model.evaluation.report import REGIONS
from scenegen.model.evaluation.run import DatasetResult, bench
from scenegen.model.evaluation.statistics import brief, figure, head, line
from scenegen.recipe import preset
from scenegen.recipes.kind import WorldKind, yaw_quaternion
from scenegen.run.software import commit
from scenegen.run.workers import Local
from scenegen.sample import Sample
from scenegen.tables import named_noise

SCAFFOLD = "elsewhere:Scaffold"
HOME = ("pillar", "geometric")
WORLDS = (*HOME, SCAFFOLD, "scenes")
"""Two kinds of training, drawn anew; a kind of no training; worlds drawn by hand."""
SENSORS_SEEN = (
    (RASTER, None),
    (RASTER, "range:0.05"),
    (RASTER, "dropout:0.1"),
    ("ouster-os1-64", None),
    ("ouster-os1-64", "datasheet,dropout:0.05"),
    ("livox-mid-360", None),
    ("realsense-d435", None),
    ("realsense-d435", "datasheet"),
)
"""Sensors and noise; the first is that of training."""
SEEN = (
    "observed voxels",
    "of these not occupied",
    "unknown voxels",
    "occupied voxels taken for free",
)
METRICS = ("iou", "near_rmse", "precision", "recall")
TABLES: dict[str, Callable[[Json], Json]] = {
    "IoU over unknown voxels": lambda found: found["unobserved"]["iou"],
    "Near-RMSE over unknown voxels, m": lambda found: found["unobserved"]["near_rmse"],
    "IoU over the whole map": lambda found: found["map"]["iou"],
    "Success of planning": lambda found: found["success"],
    "Success of the careful planner": lambda found: found["careful"],
}


@dataclass(frozen=True, kw_only=True)
class Scaffold(WorldKind):
    """Thin beams, level and crossing, at any height on slender posts: hardly a solid like those of
    the presets."""

    version: ClassVar[int] = 1
    crowded_by: ClassVar[tuple[str, ...]] = ("beam_density",)
    flight_defaults: ClassVar[dict[str, object]] = {"altitude_m": (2.0, 5.0)}

    ground: bool = True
    beam_density: tuple[float, float] = (0.03, 0.10)
    """Beams per square metre; one value a world. Every beam has two posts."""
    half_length_m: tuple[float, float] = (1.5, 5.0)
    """Half of a beam's length, metres."""
    half_edge_m: tuple[float, float] = (0.1, 0.3)
    """Half of the edges of a beam's cross-section, metres."""

    def add_to(self, spec: Any, *, rng: np.random.Generator) -> None:
        """See `WorldKind.add_to`."""
        self.add_ground(spec)
        count = round(rng.uniform(*self.beam_density) * self.size_m[0] * self.size_m[1])
        low, high = zip(
            *((0.0, edge) for edge in self.size_m[:2]), (0.5, 8.0), (0.0, np.pi), strict=True
        )
        x, y, z, yaw = rng.uniform(low, high, (count, 4)).T
        half = np.stack(
            [rng.uniform(*span, count) for span in (self.half_length_m, *[self.half_edge_m] * 2)],
            axis=1,
        )
        turn = yaw_quaternion(yaw)
        box = np.full(count, int(mujoco.mjtGeom.mjGEOM_BOX))
        spec.add_geoms(box, half, np.stack([x, y, z], axis=1), turn)
        along = np.stack(
            [1 - 2 * turn[:, 3] ** 2, 2 * turn[:, 0] * turn[:, 3]], axis=1
        )  # cos and sin of yaw
        for end in (-0.9, 0.9):
            foot = np.stack([x, y], axis=1) + end * half[:, :1] * along
            spec.add_geoms(
                np.full(count, int(mujoco.mjtGeom.mjGEOM_CYLINDER)),
                np.stack([np.full(count, 0.08), z / 2, np.zeros(count)], axis=1),
                np.column_stack([foot, z / 2]),
                np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
            )


def main() -> None:
    """Make the datasets, measure, and write."""
    parser = measuring.options(__doc__)
    parser.add_argument(
        "--maps", type=int, default=60, help="test maps of every kind of world, five a flight"
    )
    parser.add_argument("--trials", type=int, default=240, help="planning trials of every dataset")
    parser.add_argument(
        "--data", type=Path, help="folder of the datasets  [default: one that is removed again]"
    )
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--worlds", nargs="+", choices=WORLDS, default=WORLDS)
    parser.add_argument(
        "--sensors", type=int, default=len(SENSORS_SEEN), help="so many, that of training first"
    )
    parser.add_argument(
        "--weights",
        action="append",
        help="a network, as `scenegen bench` takes it  [default: all bundled]",
    )
    given = measuring.parse(
        parser, maps=5, trials=5, weights=["columns"], worlds=[SCAFFOLD], sensors=2
    )
    methods: list[Method] = [
        Completed(Returns()),
        Completed(Extrude()),
        *(Completer.from_pretrained(one, threads=1) for one in given.weights or bundled()),
    ]
    found, execute = dict[str, Any](), Local("", given.workers)
    ahead: dict[str, Ahead] = {}
    with tempfile.TemporaryDirectory() as spare:
        folder = given.data or Path(spare)
        for worlds in given.worlds:
            title = worlds.rpartition(":")[2].lower()
            original = drawn(worlds, folder / title, given.maps)
            found[title] = {}
            usual: DatasetResult | None = None
            for sensor, noise in SENSORS_SEEN[: given.sensors]:
                name = " ".join(filter(None, ("default" if sensor == RASTER else sensor, noise)))
                seen = again(original, folder / f"{title} {name.replace(':', '')}", sensor, noise)
                config = BenchConfig(trials=given.trials)
                result = bench(seen, methods, config, execute=execute)
                config = replace(config, plan=PlanConfig(planner="careful"))
                careful = bench(seen, methods, config, execute=execute)
                found[title][name] = figures(seen, result, usual or result, careful)
                for place in places(worlds, usual is None):
                    for planner, one in {"the paper's": result, "careful": careful}.items():
                        pooled = ahead.setdefault(f"{place}; {planner}", Ahead(Extrude.name))
                        pooled.add(one, [f"{title} {world}" for world in one.trial_worlds])
                usual = usual or result
                print(f"{title}, {name}", flush=True)
    report = {"commit": commit(), "maps": given.maps, "trials": given.trials, "worlds": found}
    report["ahead of extrude"] = {place: one.figures() for place, one in ahead.items()}
    given.out.mkdir(parents=True, exist_ok=True)
    rounded = json.loads(json.dumps(report), parse_float=lambda digits: round(float(digits), 4))
    (given.out / "elsewhere.json").write_text(json.dumps(rounded, separators=(",", ":")) + "\n")
    scoring.write_tables(given.out / "elsewhere.md", tables(report))


def places(worlds: str, usual: bool) -> list[str]:
    """The rows of the table of differences that a kind of worlds, seen by a sensor, belongs to."""
    if worlds in HOME:
        sensors = "as in training" if usual else "other sensors and noise"
        return [f"`pillar` and `geometric`, {sensors}"]
    return [f"{worlds.rpartition(':')[2].lower()}, all sensors", "both, all sensors"]


def drawn(worlds: str, folder: Path, maps: int) -> Dataset:
    """Test maps of the kind `worlds`, as the sensor of training sees them."""
    if worlds != "scenes":
        return scoring.drawn(folder, preset(worlds), maps)
    return scoring.drawn(folder, preset("scene"), maps, scenes=RESULTS.parents[1] / "scenes")


def again(original: Dataset, folder: Path, sensor: str, noise: str | None) -> Dataset:
    """The same worlds from the same poses, as `sensor` sees them with `noise`."""
    if (sensor, noise) == SENSORS_SEEN[0]:
        return original
    lidar = SENSORS.find(sensor) if sensor != RASTER else None
    chain = named_noise(noise, lidar or original.lidar)
    build(plan_rescan(original, folder, lidar=lidar, chain=chain))
    return Dataset(folder)


def flights(dataset: Dataset) -> np.ndarray:
    """The flight of every sample, (N,): what intervals draw again. A drawn world has one; a scene
    has several."""
    each = dataset.manifest.recipe.flight.viewpoints
    samples = dataset.split("test")
    return np.unique(
        [(one.world, one.viewpoint // each) for one in samples], axis=0, return_inverse=True
    )[1]


def figures(
    dataset: Dataset, result: DatasetResult, usual: DatasetResult, careful: DatasetResult
) -> dict[str, Any]:
    """What the sensor sees and what every method makes of it, with intervals, and how it fares with
    the `careful` planner; and how much IoU over the whole map it loses against the `usual` sensor,
    map by map."""
    flight = flights(dataset)
    seen = np.array([what_is_seen(sample) for sample in dataset.split("test")])
    said: dict[str, Any] = {
        "seen": {name: figure(seen[:, n], flight) for n, name in enumerate(SEEN)}
    }
    for name, method in result.methods.items():
        said[name] = {
            region: {metric: figure(method.values(metric, n), flight) for metric in METRICS}
            for n, region in enumerate(REGIONS)
        }
        lost = usual.methods[name].values("iou") - method.values("iou")
        said[name]["iou_lost"] = figure(lost, flight)
        for key, planned in {"success": result, "careful": careful}.items():
            success = planned.methods[name].values("success")
            said[name][key] = figure(success, planned.trial_worlds, "outcome")
    return said


def what_is_seen(sample: Sample) -> tuple[float, ...]:
    """See `SEEN`."""
    parts = (sample.observed, sample.observed & ~sample.occupancy, ~(sample.observed | sample.free))
    observed, wrong, unknown = (int(part.sum()) for part in parts)
    occupied, freed = int(sample.occupancy.sum()), int((sample.free & sample.occupancy).sum())
    return (
        observed,
        wrong / max(observed, 1),
        unknown / sample.observed.size,
        freed / max(occupied, 1),
    )


def tables(report: dict[str, Any]) -> list[str]:
    """The page's tables: for every kind of world, what was seen, then what was made of it."""
    ahead = report["ahead of extrude"]
    lines = ["", "## Success of planning, less that of `extrude`", ""]
    lines += head(next(iter(ahead.values())))
    for place, one in sorted(ahead.items()):
        lines.append(line(place, [brief(each, "+.3f") for each in one.values()]))
    for worlds, sensors in report["worlds"].items():
        methods = [name for name in next(iter(sensors.values())) if name != "seen"]
        lines += ["", f"## {worlds}", "", "What the sensors see, means over maps:", "", *head(SEEN)]
        for sensor, found in sensors.items():
            count, *shares = (found["seen"][name]["mean"] for name in SEEN)
            lines.append(line(sensor, (f"{count:.0f}", *(f"{share:.1%}" for share in shares))))
        for title, of in TABLES.items():
            lines += ["", f"{title}:", "", *head(methods)]
            lines += [
                line(sensor, (brief(of(found[name]), ".2f") for name in methods))
                for sensor, found in sensors.items()
            ]
    return lines


if __name__ == "__main__":
    main()
