# ruff: noqa
# mypy: ignore-errors
"""Maps of drawn worlds as if people had recorded them: noisy scans from a few flights, fused by
the rule of `scenegen map`.   python recorded.py OUT FIRST LAST KIND..."""

import sys
import time
from pathlib import Path

import numpy as np

from lidarsim import Pose
from lidarsim.engines.voxels import FREE, OCCUPIED, VoxelMap
from scenegen.base.errors import ScenegenError
from scenegen.draw.draw import scan_world
from scenegen.draw.source import DrawnWorlds
from scenegen.worlds.cloud import _carve, _empty_map
from scenegen.worlds.flight import fly, viewpoints
from scenegen.worlds.place import encode_map
from scenegen.worlds.recipe import make_recipe, preset

sys.path.insert(0, str(Path(__file__).parent))
SENSORS = "ouster-os0-128", "ouster-os1-64", "velodyne-hdl-64e", "hesai-xt-32", "velodyne-vlp-16"
INSIDE = "rooms", "cave", "maze", "warehouse"


def recorded(kind, n):
    rng = np.random.default_rng([77, n, sum(map(ord, kind))])
    sensor = SENSORS[int(rng.choice(5, p=[0.35, 0.25, 0.15, 0.15, 0.1]))]
    flight = {"spacing_m": float(rng.uniform(1.0, 3.0)), "flights_per_world": 5}
    if rng.random() < 0.4 and kind != "forest":
        flight["altitude_m"] = [0.5, 1.6]
    graded = None if ":" in kind else str(rng.choice(["easy", "medium", "hard"]))
    how = {"lidar": {"sensor": sensor}, "flight": flight}
    if graded:
        how["world"] = dict(preset(kind, difficulty=graded).world.graded.get(graded, {}))
    recipe = make_recipe(kind, how)
    world = DrawnWorlds(recipe).world("train", n, rng=rng)
    poses, wanted = [], int(rng.integers(6, 31))
    for _ in range(12):
        path = fly(world, recipe.flight, rng=rng)
        if path is not None:
            route, flown = viewpoints(path, recipe.flight.spacing_m, rng=rng)
            poses += [route.pose(m) for m in sorted(flown)]
        if len(poses) >= wanted:
            break
    poses = poses[:wanted]
    if len(poses) < 4:
        return None
    noise, error = rng.choice([0.005, 0.02, 0.04]), rng.choice([0.0, 0.02, 0.05])
    turned = rng.random() < 0.5
    plot = kind not in INSIDE and rng.random() < (
        0.5 if kind in ("forest", "shells:Leaves") else 0.3
    )
    voxel = 0.2 if plot else float(rng.choice([0.05, 0.1, 0.2], p=[0.15, 0.35, 0.5]))
    scans = []
    for m, pose in enumerate(poses):
        if turned:  # a sensor that tilts
            q = pose.quaternion + 0.35 * rng.standard_normal(4) * [0, 1, 1, 0]
            pose = Pose(pose.position, q / np.linalg.norm(q))
        text = f"range:{noise:g},dropout:{rng.choice([0.01, 0.05, 0.2])}"
        points = scan_world(world, recipe.lidar, pose, text, seed=[n, m]).points()
        off = error * rng.standard_normal(3)
        far = np.sqrt(((points - pose.position) ** 2).sum(axis=1))
        scans.append((points[far < 45] + off, pose.position + off))
    centre = np.mean([p.position for p in poses], axis=0)
    half = 9.0 if voxel == 0.05 else 18.0
    every = np.concatenate([points for points, _ in scans])
    low = np.maximum(every.min(axis=0), [*(centre[:2] - half), -2.0])
    high = np.minimum(every.max(axis=0), [*(centre[:2] + half), 14.0])
    states, origin = _empty_map(low, high, voxel, kind)
    occupied = np.zeros(states.shape, bool)
    if plot:  # a thinned cloud: so many points a voxel with points
        keep = float(np.exp(rng.uniform(np.log(1.5), np.log(30.0))))
        cells = len(np.unique(np.floor(every / voxel).astype(int) @ [1, 4096, 4096**2]))
        every = every[rng.random(len(every)) < min(1.0, keep * cells / len(every))]
        _carve(every, np.zeros((0, 3)), origin, voxel, states.reshape(-1), occupied)
        states[np.logical_or.accumulate(occupied, axis=2)] = FREE
    else:
        for points, start in scans:
            _carve(points, start[None], origin, voxel, states.reshape(-1), occupied)
    states[occupied] = OCCUPIED
    shares = np.bincount(states.reshape(-1), minlength=3) / states.size
    about = f"{sensor} {len(poses)} poses, voxel {voxel}, {'plot' if plot else 'rays'}, {shares.round(3)}"
    return encode_map(VoxelMap(states, voxel, origin), kind), about


out, first, last, *kinds = sys.argv[1:]
Path(out).mkdir(parents=True, exist_ok=True)
for n in range(int(first), int(last)):
    for kind in kinds:
        begin = time.time()
        file = Path(out, f"{kind.split(':')[-1].lower()}-{n:03d}.npz")
        if file.exists():
            continue
        try:
            made = recorded(kind, n)
        except ScenegenError as error:
            print(kind, n, "failed:", error, flush=True)
            continue
        if made is None:
            print(kind, n, "too few poses", flush=True)
            continue
        file.write_bytes(made[0])
        print(
            f"{kind} {n} {time.time() - begin:.1f} s {len(made[0]) // 1024} kB", made[1], flush=True
        )
