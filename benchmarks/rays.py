"""What rays cost: engines side by side among spheres, boxes and cylinders of any attitude, in one
run.

    python benchmarks/rays.py [--repeats 12] [--counts 50 200]

A scan is the default sensor's, 1920 rays up to 10 m, from six poses. Times are the processor time
of all threads, of which each engine has one, the best of several turns in which the engines
alternate, so that other work on the machine weighs on all of them alike. `mj_multiRay` is MuJoCo's
own function without anything of ours.
"""

import functools
import time
from collections.abc import Callable
from typing import Any

import measuring
import mujoco
import numpy as np
from numpy.typing import NDArray

from lidarsim import AnalyticEngine, Lidar, MujocoEngine, Pose
from lidarsim.engines.hierarchy import Hierarchy
from lidarsim.pose import rotate
from lidarsim.solids.model import solids_of

COUNTS = 50, 200, 800, 3000, 20_000
POSES = 6
YAW_RAD = 0.3
MAX_RANGE_M = 10.0
Rays = NDArray[np.float64]


def world(count: int) -> tuple[mujoco.MjModel, float]:
    """Solids of 0.2 to 0.8 m in a square, and its side, metres: 40, or more so that no more than
    one stands on 2 m²."""
    rng, spec = np.random.default_rng(0), mujoco.MjSpec()
    side = 40.0 * max(1.0, (count / 800) ** 0.5)
    geom = mujoco.mjtGeom
    shapes = geom.mjGEOM_SPHERE, geom.mjGEOM_BOX, geom.mjGEOM_CYLINDER
    for number in range(count):
        turn = rng.normal(size=4)
        size, place = rng.uniform(0.2, 0.8, 3), rng.uniform([0, 0, 0], [side, side, 5])
        spec.worldbody.add_geom(
            type=shapes[number % 3], size=size, pos=place, quat=turn / np.linalg.norm(turn)
        )
    spec.memory = max(1 << 20, 256 * count)
    return spec.compile(), side


def rays_of(lidar: Lidar, side: float) -> tuple[Rays, Rays]:
    """Origins (P, 3) and directions (P, n, 3) of scans within the square."""
    places = np.random.default_rng(1).uniform(5, side - 5, (POSES, 2))
    poses = [Pose.level((x, y, 2.5), YAW_RAD) for x, y in places]
    directions = [rotate(pose.quaternion, lidar.directions_body).reshape(-1, 3) for pose in poses]
    return np.array([pose.position for pose in poses]), np.array(directions)


def raw(model: mujoco.MjModel) -> Callable[[Rays, Rays], Rays]:
    """MuJoCo's own function."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)

    def cast(origins: Rays, directions: Rays) -> Rays:
        count = directions.shape[1]
        ranges, geoms = np.empty(directions.shape[:2]), np.empty(count, np.int32)
        for origin, rays, found in zip(origins, directions, ranges, strict=True):
            mujoco.mj_multiRay(
                model,
                data,
                origin,
                rays.reshape(-1),
                None,
                True,
                -1,
                geoms,
                found,
                None,
                count,
                MAX_RANGE_M,
            )
            found[(geoms < 0) | (found > MAX_RANGE_M)] = np.inf
        return ranges

    return cast


def best_ms(tasks: dict[str, Callable[[], Any]], repeats: int) -> dict[str, float]:
    """Processor time, the least of `repeats` turns."""
    least = dict.fromkeys(tasks, np.inf)
    for turn in range(repeats + 1):
        for name, task in tasks.items():
            begin = time.process_time()
            task()
            if turn:  # the first one compiles
                least[name] = min(least[name], 1e3 * (time.process_time() - begin))
    return least


def measure(
    count: int, repeats: int
) -> tuple[dict[str, float], dict[str, float], dict[str, int], int]:
    """Milliseconds a scan by engine, milliseconds of building, rays whose range is not
    `mj_multiRay`'s in float32, and rays."""
    model, side = world(count)
    solids, lidar = solids_of(model), Lidar()
    origins, directions = rays_of(lidar, side)
    ours, analytic = MujocoEngine.of(model), AnalyticEngine(solids, threads=1)
    shaped = directions.reshape(POSES, *lidar.shape, 3)
    tasks: dict[str, Callable[[], Any]] = {
        "mj_multiRay": functools.partial(raw(model), origins, directions),
        "mujoco": lambda: ours.cast(origins, directions, MAX_RANGE_M),
        "analytic": lambda: analytic.cast(origins, shaped, MAX_RANGE_M).reshape(POSES, -1),
    }
    ranges = {name: task().astype(np.float32) for name, task in tasks.items()}
    differ = {name: int((found != ranges["mj_multiRay"]).sum()) for name, found in ranges.items()}
    scans = {name: ms / POSES for name, ms in best_ms(tasks, repeats).items()}
    tree = Hierarchy.over(solids.lower, solids.upper)
    build = {
        "tree": lambda: Hierarchy.over(solids.lower, solids.upper),
        "refit": lambda: tree.refit(solids.lower, solids.upper),
    }
    return scans, best_ms(build, 3), differ, directions[..., 0].size


def report(count: int, repeats: int) -> None:
    """Print the table of one world."""
    scans, build, differ, rays = measure(count, repeats)
    print(f"\n{count} solids, {rays // POSES} rays a scan")
    for name, ms in scans.items():
        print(
            f"  {name:12} {ms:8.3f} ms a scan   {scans['mj_multiRay'] / ms:6.1f} times mj_multiRay"
            f"   {differ[name]:5} of {rays} ranges differ"
        )
    print("  building: " + ", ".join(f"{name} {ms:.3f} ms" for name, ms in build.items()))


def large_sensor() -> str:
    """Scans a second of 128 x 2048 rays on one core."""
    model, side = world(200)
    origins, directions = rays_of(Lidar(rows=128, columns=2048), side)
    engine = AnalyticEngine.of(model)
    ms = best_ms({"": lambda: engine.cast(origins[:1], directions[:1], MAX_RANGE_M)}, 3)[""]
    return f"128 x 2048 rays among 200 solids: {1e3 / ms:.1f} scans a second and core"


FIRST_SCAN = """
import time
import mujoco
from lidarsim import AnalyticEngine, Lidar, Pose, cast
world = '<mujoco><worldbody><geom type="box" size="1 1 1" pos="3 0 0"/></worldbody></mujoco>'
model = mujoco.MjModel.from_xml_string(world)
begin = time.process_time()
cast(AnalyticEngine.of(model), Lidar(), Pose.level((0, 0, 0), 0.3))
print(time.process_time() - begin)
"""


def first_scan(repeats: int) -> str:
    """Seconds of a process's first scan."""
    seconds = [float(measuring.run("-c", FIRST_SCAN)[1]) for _ in range(repeats)]
    return f"the first scan of a process, kernels cached: {min(seconds):.2f} s (loads numba)"


def main() -> None:
    """Print tables."""
    parser = measuring.options(__doc__)
    parser.add_argument("--repeats", type=int, default=12)
    parser.add_argument("--counts", type=int, nargs="+", default=COUNTS, help="how many solids")
    given = measuring.parse(parser, counts=[50], repeats=1)
    for count in given.counts:
        report(count, given.repeats)
    print(f"\n{large_sensor()}\n{first_scan(min(given.repeats, 3))}")


if __name__ == "__main__":
    main()
