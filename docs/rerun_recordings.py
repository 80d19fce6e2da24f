"""Recordings for Rerun: predictions beside the truth, and a flight with its time series.

Both open on their layout. They need the extra `rerun`; copy what you need.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lidarsim.pose import rotate
from scenegen import Completer, Flight, Sample
from scenegen.convert.recordings import rerun  # imports it, with its reports of use off

rr = rerun()
layout = rr.blueprint


def record_predictions(samples: Sequence[Sample], completer: Completer, path: Path | str) -> None:
    """Observed, predicted and occupied voxels of each sample, in three views."""
    names = ("observed", "prediction", "truth")
    with rr.RecordingStream("predictions") as log:
        log.save(path)
        views = [layout.Spatial3DView(origin=name, name=name) for name in names]
        log.send_blueprint(layout.Horizontal(*views))
        for number, sample in enumerate(samples):
            log.set_time("sample", sequence=number)
            grid = sample.grid
            assert grid is not None  # of every sample that `load` reads
            centres = grid.centres(sample.origin)
            masks = (sample.observed, completer(sample).occupied(), sample.occupancy)
            for name, mask in zip(names, masks, strict=True):
                log.log(name, rr.Points3D(centres[mask], radii=grid.voxel_m / 2))


def record_flight(env: Flight, path: Path | str, seed: int = 0) -> None:
    """What a robot sees that flies straight at its goal, its speed, and how far the goal is."""
    seen, _ = env.reset(seed=seed)
    ended = late = False
    with rr.RecordingStream("flight") as log:
        log.save(path)
        curves = layout.TimeSeriesView(origin="curves")
        log.send_blueprint(layout.Vertical(layout.Spatial3DView(origin="world"), curves))
        while not (ended or late):
            away = seen["goal"] - seen["position"]
            points = rotate(seen["quaternion"], seen["points"].reshape(-1, 3)) + seen["position"]
            log.set_time("time", duration=float(seen["time_s"][0]))
            log.log("world/points", rr.Points3D(points, radii=0.03))
            log.log("world/robot", rr.Points3D([seen["position"], seen["goal"]], radii=0.3))
            log.log("curves/speed", rr.Scalars(np.linalg.norm(seen["velocity"])))
            log.log("curves/goal", rr.Scalars(np.linalg.norm(away)))
            action = np.append(1.5 * away / np.linalg.norm(away), 0.0)
            seen, _, ended, late, _ = env.step(action)
