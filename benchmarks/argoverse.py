"""What `ingest --moved-share` drops of a real scan, against labels of what moves.

    python benchmarks/argoverse.py SWEEPS LOG

SWEEPS is the folder val/7fab2350-7eaf-3b7e-a39d-6937a4c1bede of the tests of `argoverse/av2-api`:
two sweeps of Argoverse 2 (Wilson et al. 2021), with labels of the first one. Rays are taken to
begin at the upper of two lidars.
"""

import tempfile
from collections.abc import Iterator
from pathlib import Path

import measuring
import numpy as np
import pandas as pd
from tyro.conf import Positional

from lidarsim import Pose
from lidarsim.engines.voxels import FREE
from lidarsim.grid import Mask
from lidarsim.pose import chained, rotate
from scenegen.logs import Fusing, LogScan
from scenegen.logs.fuse import ingest
from scenegen.logs.read import read_log
from scenegen.logs.record import write_log
from scenegen.worlds.place import read_place
from scenegen.worlds.poses import poses_of

PLACE = ["tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw"]
"""Argoverse's names of a pose's numbers."""
SHARES = (0.0, 0.2, 0.49, 0.51)
"""Values of --moved-share; of two scans, one is a half."""


class Options(measuring.Options):
    """The sweeps."""

    source: Positional[Path]
    """the folder with their files"""
    log: Positional[Path]
    """where they are written as a log"""


def main() -> None:
    """Write the log, and print what is dropped of it."""
    given = measuring.parse(Options)
    write_log(given.log, flow(given.source))
    labels = pd.read_feather(given.source / "flow_labels.feather")["dynamic"].to_numpy()
    for share in SHARES:
        print(f"moved-share {share:g}: {dropped(given.log, labels, share)}")


def flow(source: Path) -> Iterator[LogScan]:
    """Sweeps in the vehicle's frame, corrected for its motion; the first one is at 0 0 0."""
    track = pd.read_feather(source / "city_SE3_egovehicle.feather").set_index("timestamp_ns")
    mounts = pd.read_feather(source / "calibration" / "egovehicle_SE3_sensor.feather")
    mount = mounts.set_index("sensor_name").loc["up_lidar", PLACE[:3]].to_numpy(float)
    sweeps = sorted((source / "sensors" / "lidar").glob("*.feather"))
    times = [int(sweep.stem) for sweep in sweeps]
    poses = poses_of(track.loc[times, PLACE].to_numpy(), str(source))
    for time, sweep, pose in zip(times, sweeps, poses, strict=True):
        vehicle = Pose(pose.position - poses[0].position, pose.quaternion)
        points = pd.read_feather(sweep)[["x", "y", "z"]].to_numpy(float)
        yield LogScan((time - times[0]) / 1e9, chained(vehicle, Pose.level(mount)), points - mount)


def dropped(path: Path, moves: Mask, share: float) -> str:
    """Precision and recall of what `ingest` drops of a log's first scan, for which `moves` (N,)
    says which points move: of points, and of voxels that hold nothing but such points."""
    scan, how = next(read_log(path).scans()), Fusing(moved_share=share)
    with tempfile.TemporaryDirectory() as folder:
        ingest(read_log(path), Path(folder, "maps"), how)
        voxels = read_place(Path(folder, "maps", "place-000.npz")).voxels
    within = np.linalg.norm(scan.points, axis=1) < how.reach_m
    points = rotate(scan.pose.quaternion, scan.points[within]) + scan.pose.position
    index = np.floor((points - voxels.origin) / voxels.voxel_m).astype(int)
    mapped = ((index >= 0) & (index < voxels.states.shape)).all(axis=1)
    index, moves = index[mapped], moves[within][mapped]
    cells, of_point = np.unique(index, axis=0, return_inverse=True)
    standing = np.zeros(len(cells), bool)
    standing[of_point[~moves]] = True
    cell_gone = voxels.states[tuple(cells.T)] == FREE
    rows = {"points": (cell_gone[of_point], moves), "voxels": (cell_gone, ~standing)}
    return "; ".join(
        f"{len(gone)} {name}, {np.count_nonzero(real)} move, {np.count_nonzero(gone)} dropped, "
        f"{np.count_nonzero(gone & real)} both"
        for name, (gone, real) in rows.items()
    )


if __name__ == "__main__":
    main()
