"""Digests of all that lies between a seed and a stored bit, and of what differs from processor to
processor.

Run as ``python -m tests.bits`` under an environment that hides a processor's features, it prints
them as JSON.
"""

import hashlib
import json
import math
from pathlib import Path

import mujoco
import numpy as np

from lidarsim import AnalyticEngine, Lidar, Pose, cast
from lidarsim.noise import STAGES
from lidarsim.noise import returns as chance
from lidarsim.noise.chain import Noise
from lidarsim.noise.returns import albedo_of
from lidarsim.solids import solids_of
from scenegen.draw.draw import draw_unit
from scenegen.draw.source import DrawnWorlds, read_scenes
from scenegen.worlds.flight import viewpoints
from scenegen.worlds.kinds import kind_names
from scenegen.worlds.kinds.kind import attitudes, log_uniform, normal
from scenegen.worlds.recipe import preset

SCENES = Path(__file__).parent.parent / "scenes"


def digest(arrays):
    """SHA-256 of the arrays' bytes, one after the other."""
    return hashlib.sha256(
        b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)
    ).hexdigest()


def of_processor():
    """What may differ: the mathematical library, numpy's own functions, a product of matrices."""
    x = np.linspace(-9.0, 9.0, 20_001)
    random = np.random.default_rng(0).random((60, 3))
    return {
        "sin": digest([[math.sin(value) for value in x]]),
        "arctan2": digest([np.arctan2(x, x[::-1] + 0.1)]),
        "product": digest([random @ random[:3].T]),
    }


def of_datasets():
    """What must not differ: draws, directions, poses, meshes, and samples and worlds of the presets
    and the scenes; noise."""
    rng = np.random.default_rng(0)
    sensors = [
        Lidar(
            rows=7,
            columns=50,
            vertical_fov_deg=fov,
            pitch_deg=fov / 3,
            mount=("tilt", "band")[n % 2],
        )
        for n, fov in enumerate(rng.uniform(0.0, 180.0, 60))
    ]
    walk = rng.uniform(-3.0, 3.0, (3000, 3)).cumsum(axis=0)
    route, flown = viewpoints(walk, 1.0, rng=rng)
    found = {
        "log_uniform": digest([log_uniform(0.002, 0.4, rng=rng) for _ in range(2000)]),
        "normal": digest([normal((5000, 3), rng=rng)]),
        "attitudes": digest([attitudes(5000, 0.5, rng=rng)]),
        "directions": digest(sensor.directions_body for sensor in sensors),
        "poses": digest(route.pose(metres).quaternion for metres in flown),
        "mesh": digest([_mesh(rng)]),
    }
    for kind in kind_names():
        found[kind] = _flights(DrawnWorlds(preset(kind)), kind, 1)
    scenes = read_scenes(SCENES, {"train": 1, "val": 0, "test": 0}, seed=0)
    found["scenes"] = _flights(scenes, "scene", len(scenes.scenes["train"]))
    return found | _noises()


def _noises():
    """What each stage of noise makes of a scan, and their random numbers."""
    rng = np.random.default_rng(0)
    model = mujoco.MjModel.from_xml_path(str(SCENES / "warehouse.xml"))
    engine, albedo = AnalyticEngine.of(model), albedo_of(model)
    scan = cast(engine, Lidar(rows=40, columns=300), Pose.level((8.0, 6.0, 1.5), 0.5))
    found = {
        "noise, normal": digest([chance.normal((100_000,), rng=rng)]),
        "noise, on_circle": digest(chance.on_circle((100_000,), rng=rng)),
    }
    for stage in (*STAGES.builtin, "far:0.9:1.7", "grazing:0", "intensity:0.1"):
        seen = Noise.parse(stage).observe(scan, engine, rng=rng, albedo=albedo)
        intensity = [] if seen.intensity is None else [seen.intensity]
        found[f"noise, {stage}"] = digest([seen.ranges, seen.points(), *intensity])
    return found


def _flights(source, kind, units):
    total = hashlib.sha256()
    for unit in range(units):
        drawn = draw_unit(source, preset(kind), seed=0, split="train", unit=unit)
        total.update(drawn.world.mjcf)
        for sample in drawn.samples:
            total.update(sample.sha256() + digest([sample.free, sample.tudf]).encode())
    return total.hexdigest()


def _mesh(rng):
    """Corners of turned meshes in the world."""
    spec = mujoco.MjSpec()
    spec.add_mesh(name="m", uservert=rng.uniform(-1.0, 1.0, 300).tolist())
    for attitude in attitudes(20, 1.0, rng=rng):
        place = rng.uniform(-9.0, 9.0, 3)
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH, meshname="m", quat=attitude, pos=place
        )
    return solids_of(spec.compile()).triangles


if __name__ == "__main__":
    print(json.dumps({"processor": of_processor(), "datasets": of_datasets()}))
