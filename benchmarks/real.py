"""How completions of real places compare with those of drawn worlds, by one measure.

    python benchmarks/real.py campus.bt:15 geb079.bt:5 forest0.bt:3     # docs/results/real.md

A file is an OctoMap; the number behind it says how many metres apart poses are at least. The
paper's sensor is put into free space, .8 to 2.8 m above something, .6 m from all that is occupied.
A pose is kept where a quarter of the rays return and fewer than 35 % cross more than .6 m of
unknown space. Scores are over known voxels alone. Drawn worlds are made maps of .2 m first, all of
it known, and are seen from their own flights.
"""

from collections.abc import Iterator
from pathlib import Path

import measuring
import numpy as np
from numpy.typing import NDArray

from lidarsim import GridSpec, Pose, cast, voxelize
from lidarsim.engines.voxels import FREE, OCCUPIED, VoxelEngine, VoxelMap
from lidarsim.pose import rotate
from scenegen.draw import draw_unit
from scenegen.model.completion.completer import Completer
from scenegen.model.completion.unlearned import Extrude
from scenegen.model.evaluation.statistics import figure, head, interval, line
from scenegen.recipe import preset
from scenegen.source import DrawnWorlds
from scenegen.truth import rasterize
from scenegen.truth.voxels import resample
from scenegen.worlds.octomap import read_octomap
from scenegen.worlds.world import solid

PAGE = Path(__file__).parents[1] / "docs" / "results" / "real.md"
NETWORKS = ("columns", "proposed", "occ")
KINDS = ("pillar", "geometric")
THRESHOLDS = np.arange(1, 20) / 20
BELOW_M, AWAY_M, UNKNOWN_M = (0.8, 2.8), 0.6, 0.6
RETURNED, THROUGH_UNKNOWN = 0.25, 0.35
TRIES = 200_000
"""Free voxels that are tried, at most."""


def main() -> None:
    """Score every place, and write the table."""
    parser = measuring.options(__doc__)
    parser.add_argument("maps", nargs="*", help="an OctoMap and metres between poses: campus.bt:15")
    parser.add_argument("--poses", type=int, default=24, help="of each map, at most")
    parser.add_argument("--worlds", type=int, default=24, help="of each drawn kind, a pose each")
    parser.add_argument("--network", action="append", help="a bundled one's name, or a run")
    parser.add_argument("--page", type=Path, default=PAGE)
    given = measuring.parse(parser, poses=2, worlds=2, network=["columns"])
    methods = {"extrude": Extrude()} | {
        Path(name).name: Completer.from_pretrained(name) for name in given.network or NETWORKS
    }
    places = {kind: drawn(kind, given.worlds) for kind in KINDS[: 1 if given.smoke else None]}
    for words in given.maps:
        name, _, apart = words.rpartition(":")
        rng = np.random.default_rng(0)
        places[Path(name).stem] = views(read_octomap(Path(name)), float(apart), given.poses, rng)
    rows = []
    for place, found in places.items():
        scores = measured(list(found), methods)
        cells = [str(len(next(iter(scores.values()))))]
        for name, values in scores.items():
            best = int(values.mean(axis=0).argmax())
            own = figure(values[:, best], range(len(values)))
            at = "" if name == "extrude" else f" at {THRESHOLDS[best]:g}"
            cells.append(f"{own['mean']:.2f} {interval(own, '.2f')}{at}")
        rows.append(line(f"`{place}`", cells))
        print(f"{place}: " + ", ".join(f"{n} {c}" for n, c in zip(scores, cells[1:], strict=True)))
    said = given.page.read_text().partition("<!-- table -->")[0] if given.page.exists() else ""
    if not given.smoke:
        table = "\n".join([*head(("poses", *methods)), *rows])
        given.page.write_text(f"{said}<!-- table -->\n\n{table}\n")


def drawn(kind: str, worlds: int) -> Iterator[tuple[VoxelMap, Pose]]:
    """A pose in each of some worlds of a kind, as a map."""
    recipe = preset(kind)
    for number in range(worlds):
        unit = draw_unit(DrawnWorlds(recipe), recipe, seed=0, split="test", unit=number)
        (sample, *_), half = unit.samples, recipe.grid.extent_m / 2
        low = np.floor((sample.position - half) / recipe.grid.voxel_m - 1) * recipe.grid.voxel_m
        nx, ny, nz = recipe.grid.shape
        around = GridSpec(shape=(nx + 3, ny + 3, nz + 3), voxel_m=recipe.grid.voxel_m)
        filled = rasterize(solid(unit.world, "drawn").solids, around, low)
        states = np.where(filled, OCCUPIED, FREE).astype(np.uint8)
        yield VoxelMap(states, around.voxel_m, low), Pose(sample.position, sample.quaternion)


def views(
    voxels: VoxelMap, apart_m: float, most: int, rng: np.random.Generator
) -> Iterator[tuple[VoxelMap, Pose]]:
    """Poses from which a sensor sees enough of what is known."""
    lidar, engine, kept = preset("pillar").lidar, VoxelEngine(voxels), list[NDArray[np.float64]]()
    free = np.flatnonzero(voxels.states == FREE)
    for at in rng.permutation(free)[:TRIES] if len(free) else ():
        cell = np.array(np.unravel_index(at, voxels.states.shape))
        position = voxels.origin + (cell + 0.5) * voxels.voxel_m
        if any(((position - other) ** 2).sum() < apart_m**2 for other in kept):
            continue
        if len(kept) == most:
            return
        if not stands(voxels, cell):
            continue
        pose = Pose.level(position, rng.uniform(-np.pi, np.pi))
        rays = rotate(pose.quaternion, lidar.directions_body)[None]
        ranges, unknown_m = engine.cross(position[None], rays, lidar.max_range_m)
        if np.isfinite(ranges).mean() < RETURNED:
            continue
        if (unknown_m > UNKNOWN_M).mean() < THROUGH_UNKNOWN:
            kept.append(position)
            yield voxels, pose


def stands(voxels: VoxelMap, cell: NDArray[np.int64]) -> bool:
    """Whether a voxel has something below it, and nothing too near."""
    x, y, z = cell.tolist()
    low, high = (round(metres / voxels.voxel_m) for metres in BELOW_M)
    if not (voxels.states[x, y, max(z - high, 0) : max(z - low, 0)] == OCCUPIED).any():
        return False
    away = int(np.ceil(AWAY_M / voxels.voxel_m))
    near = tuple(slice(max(at - away, 0), at + away + 1) for at in (x, y, z))
    return not (voxels.states[near] == OCCUPIED).any()


def measured(
    places: list[tuple[VoxelMap, Pose]], methods: dict[str, Extrude | Completer]
) -> dict[str, NDArray[np.float64]]:
    """IoU over known voxels, (poses, thresholds), of every method."""
    grid, lidar = preset("pillar").grid, preset("pillar").lidar
    scores: dict[str, list[NDArray[np.float64]]] = {name: [] for name in methods}
    for voxels, pose in places:
        scan = cast(VoxelEngine(voxels), lidar, pose)
        seen = voxelize(scan, grid)
        truth, known = resample(voxels, grid, seen.origin)
        for name, method in methods.items():
            found = method.complete(seen.observed, seen.free, grid=grid)
            said = np.asarray(found.occupancy_probability)[known]
            occupied = said >= THRESHOLDS[:, None]
            both, either = occupied & truth[known], occupied | truth[known]
            scores[name].append(both.sum(axis=1) / either.sum(axis=1))
    return {name: np.array(values) for name, values in scores.items()}


if __name__ == "__main__":
    main()
