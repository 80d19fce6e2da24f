"""Digests of all that lies between a seed and a stored bit.

Run as ``python -m tests.bits`` under an environment that hides a processor's features, it prints
them as JSON.
"""

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np

from lidarsim import AnalyticEngine, Lidar, Pose, cast
from lidarsim.noise import STAGES
from lidarsim.noise import returns as chance
from lidarsim.noise.chain import Noise
from lidarsim.noise.returns import albedo_of
from scenegen.draw.draw import draw_unit
from scenegen.draw.source import DrawnWorlds, read_scenes
from scenegen.worlds.kinds import kind_names
from scenegen.worlds.recipe import preset
from scenegen.worlds.traffic import PRESETS

SCENES = Path(__file__).parent.parent / "scenes"


def digest(arrays):
    """SHA-256 of the arrays' bytes, one after the other."""
    return hashlib.sha256(
        b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)
    ).hexdigest()


def of_datasets():
    """What must not differ: draws, directions, poses, meshes, and samples and worlds of the presets
    and the scenes; noise."""
    rng, found = np.random.default_rng(0), {}
    sensors = (
        Lidar(rows=7, columns=50, vertical_fov_deg=fov, pitch_deg=fov / 3, mount=mount)
        for fov, mount in zip(rng.uniform(0.0, 180.0, 60), ("tilt", "band") * 30, strict=True)
    )
    found["directions"] = digest(sensor.directions_body for sensor in sensors)
    for kind in kind_names():
        found[kind] = _flights(DrawnWorlds(preset(kind)), preset(kind), 1)
    moving = replace(preset("street"), parts={"movers": PRESETS["dense"]})
    found["movers"] = _flights(DrawnWorlds(moving), moving, 1)
    scenes = read_scenes(SCENES, {"train": 1, "val": 0, "test": 0}, seed=0)
    found["scenes"] = _flights(scenes, preset("scene"), len(scenes.scenes["train"]))
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


def _flights(source, recipe, units):
    total = hashlib.sha256()
    for unit in range(units):
        drawn = draw_unit(source, recipe, seed=0, split="train", unit=unit)
        total.update(drawn.world.mjcf)
        for sample in drawn.samples:
            total.update(sample.sha256() + digest([sample.free, sample.tudf]).encode())
    return total.hexdigest()


if __name__ == "__main__":
    print(json.dumps(of_datasets()))
