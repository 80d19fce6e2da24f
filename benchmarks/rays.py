"""What rays cost: our engine and MuJoCo's own function, `mj_multiRay`, side by side among spheres,
boxes and cylinders of any attitude.

    python benchmarks/rays.py [--repeats 12] [--counts 50 200]

A scan is the default sensor's, 1920 rays up to 10 m, from six poses. Times are the processor time
of one thread, the best of several turns in which both alternate, so that other work on the machine
weighs on them alike.
"""

from collections.abc import Callable, Sequence
from functools import partial

import measuring
import mujoco
import numpy as np

from lidarsim import AnalyticEngine, Lidar, Pose
from lidarsim.engines.hierarchy import Hierarchy
from lidarsim.grid import Floats
from lidarsim.pose import rotate
from lidarsim.solids import solids_of

COUNTS = 50, 200, 800, 3000, 20_000
POSES = 6
YAW_RAD = 0.3
MAX_RANGE_M = 10.0


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


def rays_of(lidar: Lidar, side: float) -> tuple[Floats, Floats]:
    """Origins (P, 3) and directions (P, *lidar.shape, 3) of scans within the square."""
    places = np.random.default_rng(1).uniform(5, side - 5, (POSES, 2))
    poses = [Pose.level((x, y, 2.5), YAW_RAD) for x, y in places]
    directions = [rotate(pose.quaternion, lidar.directions_body) for pose in poses]
    return np.array([pose.position for pose in poses]), np.array(directions)


def raw(model: mujoco.MjModel, origins: Floats, directions: Floats) -> Callable[[], None]:
    """MuJoCo's own function, about to cast rays."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    flat = directions.reshape(POSES, -1)
    count = flat.shape[1] // 3
    ranges, geoms = np.empty(count), np.empty(count, np.int32)

    def cast() -> None:
        for origin, rays in zip(origins, flat, strict=True):
            about = (None, True, -1, geoms, ranges, None, count, MAX_RANGE_M)
            mujoco.mj_multiRay(model, data, origin, rays, *about)

    return cast


def best_ms(tasks: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Processor time, the least of `repeats` turns."""
    times = measuring.in_turn(tasks, repeats, of=min)
    return {name: one.processor for name, one in times.items()}


def report(count: int, repeats: int) -> None:
    """Print the table of one world."""
    model, side = world(count)
    solids, lidar = solids_of(model), Lidar()
    rays = rays_of(lidar, side)
    engine, tree = AnalyticEngine(solids, threads=1), Hierarchy.over(solids.lower, solids.upper)
    scans = best_ms(
        {
            "mj_multiRay": raw(model, *rays),
            "analytic": partial(engine.cast, *rays, MAX_RANGE_M),
        },
        repeats,
    )
    building = best_ms(
        {
            "tree": partial(Hierarchy.over, solids.lower, solids.upper),
            "refit": partial(tree.refit, solids.lower, solids.upper),
        },
        3,
    )
    print(f"\n{count} solids, {lidar.directions_body[..., 0].size} rays a scan")
    for name, ms in scans.items():
        print(
            f"  {name:12} {ms / POSES:8.3f} ms a scan   "
            f"{scans['mj_multiRay'] / ms:6.1f} times mj_multiRay"
        )
    print("  building: " + ", ".join(f"{name} {ms:.3f} ms" for name, ms in building.items()))


def large_sensor() -> str:
    """Scans a second of 128 x 2048 rays on one core."""
    model, side = world(200)
    origins, directions = rays_of(Lidar(rows=128, columns=2048), side)
    cast = partial(AnalyticEngine.of(model).cast, origins[:1], directions[:1], MAX_RANGE_M)
    ms = best_ms({"": cast}, 3)[""]
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


class Options(measuring.Options):
    """How often, and where."""

    repeats: int = 12
    counts: Sequence[int] = COUNTS
    """how many solids"""


def main() -> None:
    """Print tables."""
    given = measuring.parse(Options, counts=[50], repeats=1)
    for count in given.counts:
        report(count, given.repeats)
    print(f"\n{large_sensor()}\n{first_scan(min(given.repeats, 3))}")


if __name__ == "__main__":
    main()
