"""What a GPU does: rays a second, and samples a second with voxels and exact truth, in many
different worlds at once.

    python benchmarks/gpu.py [--worlds 1024] [--seconds 3]

A sample is the preset's sensor and grid at the first pose of a flight, every one in a world of its
own. Worlds are drawn and packed on the processor before the clock runs. The three-solid scene is a
ball, a box and an upright cylinder of 1 m, 4 m from the sensor, which turns 65 536 rays all around,
from 64 poses. What is timed is first held to the processor's, bit by bit, in sixteen worlds. Times
are the wall clock's, over as many launches as fit the seconds given.

Published, by others on their own scenes: 231 million rays a second (mujoco-lidar, JAX), 328 million
(OmniPerception, on an RTX 4090). Without a GPU there is nothing to measure: one line says so, and
the exit status is 1.
"""

import sys
import time
from collections.abc import Callable
from typing import Any

import measuring
import mujoco
import numpy as np

import lidarsim
from lidarsim import AnalyticEngine, Lidar, Pose
from lidarsim.gpu import WarpEngine
from lidarsim.pose import rotate
from lidarsim.solids.model import solids_of
from lidarsim.solids.shapes import Solids
from scenegen.draw import draw_unit
from scenegen.recipe import preset
from scenegen.recipes import kind_names
from scenegen.source import DrawnWorlds
from scenegen.truth import distance_field, rasterize
from scenegen.worlds.world import solid

CHECKED = 16
"""Worlds in which what the device gives is compared with what the processor gives."""
THREE = """<mujoco><worldbody>
<geom type="sphere" size="1" pos="4 0 0"/><geom type="box" size="1 1 1" pos="-2 3.5 0"/>
<geom type="cylinder" size="1 1" pos="-2 -3.5 0"/></worldbody></mujoco>"""


def per_second(task: Callable[[], Any], seconds: float) -> float:
    """Runs of `task` a second, its work on the device included; the first two warm up."""
    import warp as wp

    for _ in range(2):
        task()
    wp.synchronize()
    begin, runs = time.perf_counter(), 0
    while time.perf_counter() - begin < seconds:
        for _ in range(8):
            task()
        wp.synchronize()
        runs += 8
    return runs / (time.perf_counter() - begin)


class Batch:
    """Poses in worlds of their own, on the device."""

    def __init__(self, solids: list[Solids], poses: list[Pose], lidar: Any, grid: Any, device: str):
        from lidarsim.gpu.worlds import Worlds, wp

        self.solids, self.poses, self.lidar, self.grid = solids, poses, lidar, grid
        begin = time.perf_counter()
        self.worlds = Worlds(solids, device=device)
        self.packed_ms = 1e3 * (time.perf_counter() - begin) / len(solids)
        origins = np.array([pose.position for pose in poses])
        rays = np.array(
            [rotate(pose.quaternion, lidar.directions_body).reshape(-1, 3) for pose in poses]
        )
        self.origins, self.rays, self.corners = (
            wp.array(values, dtype=wp.vec3d, device=self.worlds.device)
            for values in (origins, rays, grid.origin_at(origins))
        )

    def cast(self) -> Any:
        """Ranges (P, R)."""
        from lidarsim.gpu.rays import cast

        return cast(self.worlds, self.origins, self.rays, self.lidar.max_range_m)

    def sample(self) -> list[Any]:
        """Ranges, observed and free voxels, occupancy and distances."""
        from lidarsim.gpu.rays import voxelize
        from scenegen.truth import gpu

        ranges = self.cast()
        seen = voxelize(
            ranges,
            self.origins,
            self.rays,
            self.lidar.max_range_m,
            grid=self.grid,
            corners=self.corners,
        )
        occupancy = gpu.rasterize(self.worlds, self.grid, self.corners)
        return [ranges, *seen, occupancy, gpu.distance_field(occupancy, self.grid)]

    def differing(self) -> int:
        """Ranges and voxels of the first worlds that are not the processor's."""
        found = [array.numpy()[:CHECKED] for array in self.sample()]
        count = 0
        for p, (solids, pose) in enumerate(zip(self.solids[:CHECKED], self.poses, strict=False)):
            scan = lidarsim.cast(AnalyticEngine(solids), self.lidar, pose)
            seen = lidarsim.voxelize(scan, self.grid)
            occupancy = rasterize(solids, self.grid, seen.origin)
            true = [
                scan.ranges.reshape(-1),
                seen.observed,
                seen.free,
                occupancy,
                distance_field(occupancy, self.grid),
            ]
            count += sum(
                int((one[p].astype(other.dtype) != other).sum())
                for one, other in zip(found, true, strict=True)
            )
        return count


def preset_batch(kind: str, worlds: int, device: str) -> Batch:
    """The first view of so many flights of a preset."""
    recipe = preset(kind)
    source = DrawnWorlds(recipe)
    units = [
        draw_unit(source, recipe, seed=0, split="train", unit=n, derived=False)
        for n in range(worlds)
    ]
    poses = [Pose(unit.samples[0].position, unit.samples[0].quaternion) for unit in units]
    return Batch(
        [solid(unit.world, "drawn").solids for unit in units],
        poses,
        recipe.lidar,
        recipe.grid,
        device,
    )


def three_solids(sensors: int, device: str) -> Batch:
    """So many sensors among three solids."""
    solids = solids_of(mujoco.MjModel.from_xml_string(THREE))
    lidar = Lidar(rows=64, columns=1024, vertical_fov_deg=90.0)
    poses = [Pose.level((0, 0, 0), 2 * np.pi * n / sensors) for n in range(sensors)]
    return Batch([solids] * sensors, poses, lidar, preset("pillar").grid, device)


def main() -> None:
    """Print a table."""
    parser = measuring.options(__doc__)
    parser.add_argument(
        "--worlds", type=int, default=1024, help="different worlds at once, of each preset"
    )
    parser.add_argument("--sensors", type=int, default=64, help="poses among three solids")
    parser.add_argument("--kind", nargs="+", choices=kind_names(), default=["geometric", "pillar"])
    parser.add_argument("--seconds", type=float, default=3.0, help="for each figure")
    parser.add_argument("--device", default="cuda", help="cpu: Warp's, for want of another")
    given = measuring.parse(parser, kind=["pillar"], worlds=1, sensors=1, seconds=0, device="cpu")
    if given.device != "cpu" and (missing := WarpEngine.missing()):
        sys.exit(f"nothing measured: this {missing}")
    print(f"{given.device}: {given.worlds} different worlds of each preset at once")
    for name in ("three solids", *given.kind):
        if name == "three solids":
            batch = three_solids(given.sensors, given.device)
        else:
            batch = preset_batch(name, given.worlds, given.device)
        differing = batch.differing()
        rays = per_second(batch.cast, given.seconds) * batch.rays.size
        samples = per_second(batch.sample, given.seconds) * len(batch.poses)
        print(
            f"  {name:14} {rays / 1e6:9.1f} M rays/s  {samples:9.0f} samples/s with truth  "
            f"{batch.packed_ms:.2f} ms to pack a world  "
            f"{differing} values differ from the processor's"
        )


if __name__ == "__main__":
    main()
