"""What rays cost: engines side by side among spheres, boxes and cylinders of any attitude, in one run.

    python benchmarks/rays.py [--json] [--repeats 12]

A scan is the default sensor's, 1920 rays up to 10 m, from six poses. Times are one thread's processor time, the best of
several turns in which the engines alternate, so that other work on the machine weighs on all of them alike.
`mj_multiRay` is MuJoCo's own function without anything of ours. Peers are measured where they are installed: `open3d`
and `embreex`, both Embree, on the same solids as meshes, curved ones to 1 cm, building excluded.

With `--json`, one line: milliseconds a scan by count of solids and by engine.
"""

import argparse
import importlib
import importlib.util
import json
import time
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from lidarsim import AnalyticEngine, Lidar, MujocoEngine, Pose
from lidarsim.engines.hierarchy import Hierarchy
from lidarsim.pose import rotate
from lidarsim.solids.model import solids_of
from lidarsim.solids.shapes import BOX, SPHERE, Solids

COUNTS = 50, 200, 800, 3000, 20_000
POSES = 6
MAX_RANGE_M = 10.0
CURVE_M = 0.01
"""How far a peer's mesh may be from a curved solid."""
Rays = NDArray[np.float64]


def world(count: int) -> tuple[mujoco.MjModel, float]:
    """Solids of 0.2 to 0.8 m in a square, and its side, metres: 40, or more so that no more than one stands on 2 m²."""
    rng, spec = np.random.default_rng(0), mujoco.MjSpec()
    side = 40.0 * max(1.0, (count / 800) ** 0.5)
    shapes = [mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER]
    for number in range(count):
        turn = rng.normal(size=4)
        size, place = rng.uniform(0.2, 0.8, 3), rng.uniform([0, 0, 0], [side, side, 5])
        spec.worldbody.add_geom(type=shapes[number % 3], size=size, pos=place, quat=turn / np.linalg.norm(turn))
    spec.memory = max(1 << 20, 256 * count)
    return spec.compile(), side


def rays_of(lidar: Lidar, side: float) -> tuple[Rays, Rays]:
    """Origins (P, 3) and directions (P, n, 3) of scans within the square."""
    places = np.random.default_rng(1).uniform(5, side - 5, (POSES, 2))
    poses = [Pose.level((x, y, 2.5), 0.3) for x, y in places]
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
                model, data, origin, rays.reshape(-1), None, True, -1, geoms, found, None, count, MAX_RANGE_M
            )
            found[(geoms < 0) | (found > MAX_RANGE_M)] = np.inf
        return ranges

    return cast


def peers(solids: Solids) -> dict[str, Callable[[Rays, Rays], Any]]:
    """Embree's wrappers, where they are installed, each on the same meshes."""
    found: dict[str, Callable[[Rays, Rays], Any]] = {}
    if importlib.util.find_spec("open3d"):
        open3d = importlib.import_module("open3d")

        scene, mesh = open3d.t.geometry.RaycastingScene(nthreads=1), meshed(solids)
        scene.add_triangles(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))

        def by_open3d(origins: Rays, directions: Rays) -> list[Any]:
            starts = np.broadcast_to(origins[:, None], directions.shape)
            both = np.concatenate([starts, directions], axis=-1, dtype=np.float32)
            return [scene.cast_rays(open3d.core.Tensor(one), nthreads=1)["t_hit"].numpy() for one in both]

        found["open3d"] = by_open3d
    if importlib.util.find_spec("embreex"):
        from trimesh.ray.ray_pyembree import RayMeshIntersector

        caster = RayMeshIntersector(meshed(solids))

        def by_embreex(origins: Rays, directions: Rays) -> list[Any]:
            return [
                caster.intersects_first(np.broadcast_to(origin, rays.shape), rays)
                for origin, rays in zip(origins, directions, strict=True)
            ]

        found["embreex"] = by_embreex
    return found


def meshed(solids: Solids) -> Any:
    """The world's spheres, boxes and cylinders as one mesh."""
    import trimesh

    parts = []
    for shape, size, place, turn in zip(solids.shape, solids.size, solids.position, solids.rotation, strict=True):
        frame = np.eye(4)
        frame[:3, :3], frame[:3, 3] = turn, place
        corners = int(np.ceil(np.pi / np.arccos(1 - CURVE_M / size[0])))  # around a circle
        if shape == BOX:
            part = trimesh.creation.box(2 * size)
        elif shape == SPHERE:
            part = trimesh.creation.uv_sphere(size[0], count=[corners, corners])
        else:
            part = trimesh.creation.cylinder(size[0], 2 * size[1], sections=corners)
        parts.append(part.apply_transform(frame))
    return trimesh.util.concatenate(parts)


def best_ms(tasks: dict[str, Callable[[], Any]], repeats: int) -> dict[str, float]:
    """Processor time of one thread, the least of `repeats` turns."""
    least = dict.fromkeys(tasks, np.inf)
    for turn in range(repeats + 1):
        for name, task in tasks.items():
            begin = time.thread_time()
            task()
            if turn:  # the first one compiles
                least[name] = min(least[name], 1e3 * (time.thread_time() - begin))
    return least


def measure(count: int, repeats: int) -> tuple[dict[str, float], dict[str, float], int, int]:
    """Milliseconds a scan by engine, milliseconds of building, rays that differ in float32, and rays."""
    model, side = world(count)
    solids = solids_of(model)
    origins, directions = rays_of(Lidar(), side)
    ours, analytic, theirs = MujocoEngine.of(model), AnalyticEngine(solids, threads=1), raw(model)
    tasks = {
        "mj_multiRay": lambda: theirs(origins, directions),
        "mujoco": lambda: ours.cast(origins, directions, MAX_RANGE_M),
        "analytic": lambda: analytic.cast(origins, directions, MAX_RANGE_M),
    }
    for name, cast in peers(solids).items():
        tasks[name] = lambda cast=cast: cast(origins, directions)  # type: ignore[misc]
    scans = {name: ms / POSES for name, ms in best_ms(tasks, repeats).items()}
    tree = Hierarchy.over(solids.lower, solids.upper)
    build = {
        "tree": lambda: Hierarchy.over(solids.lower, solids.upper),
        "refit": lambda: tree.refit(solids.lower, solids.upper),
        "engine": lambda: AnalyticEngine(solids),
        "solids": lambda: solids_of(model),
    }
    one, other = tasks["mj_multiRay"](), tasks["analytic"]()
    differ = int((one.astype(np.float32) != other.astype(np.float32)).sum())
    return scans, best_ms(build, 3), differ, one.size


def main() -> None:
    """Print tables, or one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="one line: milliseconds a scan by count and engine")
    parser.add_argument("--repeats", type=int, default=12)
    given = parser.parse_args()
    if given.json:
        print(json.dumps({str(count): measure(count, given.repeats)[0] for count in COUNTS}))
        return
    for count in COUNTS:
        scans, build, differ, rays = measure(count, given.repeats)
        print(f"\n{count} solids, {rays // POSES} rays a scan; {differ} of {rays} ranges differ in float32")
        for name, ms in scans.items():
            print(f"  {name:12} {ms:8.3f} ms a scan   {scans['mj_multiRay'] / ms:6.1f} times mj_multiRay")
        print("  building: " + ", ".join(f"{name} {ms:.3f} ms" for name, ms in build.items()))
    model, side = world(200)
    origins, directions = rays_of(Lidar(rows=128, columns=2048), side)
    engine = AnalyticEngine.of(model)
    ms = best_ms({"": lambda: engine.cast(origins[:1], directions[:1], MAX_RANGE_M)}, 3)[""]
    print(f"\n128 x 2048 rays among 200 solids: {1e3 / ms:.1f} scans a second and core")


if __name__ == "__main__":
    main()
