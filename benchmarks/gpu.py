"""What a GPU does: rays a second, and samples a second with voxels and exact truth, in many
different worlds at once.

    python benchmarks/gpu.py [--worlds 1024] [--seconds 3]

A sample is the preset's sensor and grid at the first pose of a flight, every one in a world of its
own. Worlds are drawn and packed on the processor before the clock runs. What is timed is first held
to what the processor draws, bit by bit, in sixteen worlds. Times are the wall clock's, over as many
launches as fit the seconds given.

Published, by others on their own scenes: 231 million rays a second (mujoco-lidar, JAX), 328 million
(OmniPerception, on an RTX 4090). Without a GPU there is nothing to measure: one line says so, and
the exit status is 1.
"""

import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import measuring
import numpy as np

from lidarsim.gpu import WarpEngine
from scenegen import Sample, preset
from scenegen.draw import draw_unit
from scenegen.source import DrawnWorlds
from scenegen.worlds.world import solid

CHECKED = 16
"""Worlds in which what the device gives is compared with what the processor gives."""


class Options(measuring.Options):
    """What is measured, and where."""

    worlds: int = 1024
    """different worlds at once, of each preset"""
    kind: Sequence[str] = ("geometric", "pillar")
    seconds: float = 3.0
    """for each figure"""
    device: str = "cuda"
    """cpu: Warp's, for want of another"""


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
    """The first view of so many flights of a preset, in worlds of their own, on the device."""

    def __init__(self, kind: str, worlds: int, device: str):
        from lidarsim.gpu.worlds import Worlds, wp

        recipe = preset(kind)
        self.grid, self.far_m = recipe.grid, recipe.lidar.max_range_m
        self.drawn: list[Sample] = []
        """What the processor gives in the first worlds."""
        solids, origins, rays = [], [], []
        for n in range(worlds):
            unit = draw_unit(
                DrawnWorlds(recipe), recipe, seed=0, split="train", unit=n, derived=n < CHECKED
            )
            sample = unit.samples[0]
            (scan,) = sample.scans()
            solids.append(solid(unit.world, "drawn").solids)
            origins.append(scan.pose.position)
            rays.append(scan.directions.reshape(-1, 3))
            self.drawn += [sample] if n < CHECKED else []
        begin = time.perf_counter()
        self.worlds = Worlds(solids, device=device)
        self.packed_ms = 1e3 * (time.perf_counter() - begin) / worlds
        self.origins, self.rays, self.corners = (
            wp.array(np.array(values), dtype=wp.vec3d, device=self.worlds.device)
            for values in (origins, rays, self.grid.origin_at(np.array(origins)))
        )

    def cast(self) -> Any:
        """Ranges (P, R)."""
        from lidarsim.gpu.rays import cast

        return cast(self.worlds, self.origins, self.rays, self.far_m)

    def sample(self) -> dict[str, Any]:
        """What the processor's samples have by these names, too."""
        from lidarsim.gpu.rays import voxelize
        from scenegen.truth import gpu

        ranges = self.cast()
        scan = (ranges, self.origins, self.rays, self.far_m)
        observed, free = voxelize(*scan, grid=self.grid, corners=self.corners)
        occupancy = gpu.rasterize(self.worlds, self.grid, self.corners)
        return {
            "ranges": ranges,
            "observed": observed,
            "free": free,
            "occupancy": occupancy,
            "tudf": gpu.distance_field(occupancy, self.grid),
        }

    def differing(self) -> int:
        """Ranges and voxels of the first worlds that are not the processor's."""
        count = 0
        for name, array in self.sample().items():
            true = np.array([getattr(one, name) for one in self.drawn])
            found = array.numpy()[:CHECKED].reshape(true.shape)
            count += int((found.astype(true.dtype) != true).sum())
        return count


def main() -> None:
    """Print a table."""
    given = measuring.parse(Options, kind=["pillar"], worlds=1, seconds=0, device="cpu")
    if given.device != "cpu" and (missing := WarpEngine.missing()):
        sys.exit(f"nothing measured: this {missing}")
    print(f"{given.device}: {given.worlds} different worlds of each preset at once")
    for kind in given.kind:
        batch = Batch(kind, given.worlds, given.device)
        differing = batch.differing()
        rays = per_second(batch.cast, given.seconds) * batch.rays.size
        samples = per_second(batch.sample, given.seconds) * given.worlds
        print(
            f"  {kind:14} {rays / 1e6:9.1f} M rays/s  {samples:9.0f} samples/s with truth  "
            f"{batch.packed_ms:.2f} ms to pack a world  "
            f"{differing} values differ from the processor's"
        )


if __name__ == "__main__":
    main()
