"""Whether a stranger's odometry finds its way in our logs: KISS-ICP (Vizzo et al. 2023), which
knows nothing of scenegen, on a log of each kind of worlds. Needs `pip install kiss-icp`.

    python benchmarks/odometry.py pillar forest --seeds 3
    python benchmarks/odometry.py pillar --moving
    python benchmarks/odometry.py rooms --voxels 1 0.3 --speed 1.5

Per kind and seed: metres flown, scans, and for each edge of the voxels of KISS-ICP's map the mean
error of relative translation, %, and rotation, degrees a metre, as KITTI's odometry counts them:
over all ways of 100, 200 … 800 m. Its own choice is a hundredth of the sensor's range.
"""

import itertools
import tempfile
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import measuring
import numpy as np
from tyro.conf import Positional

from scenegen.logs.read import read_log
from scenegen.logs.record import matrix_of


class Options(measuring.Options):
    """What flies where."""

    kinds: Positional[Sequence[str]] = ("pillar", "forest", "street", "warehouse")
    length: float = 210
    speed: float = 5
    """metres a second"""
    lidar: str = "ouster-os1-64"
    seeds: int = 1
    """worlds of each kind"""
    moving: bool = False
    voxels: Sequence[float] = (1.0,)
    """edges, metres"""


def main() -> None:
    """Print a line for each kind and seed."""
    given = measuring.parse(Options, kinds=["pillar"], length=110, lidar="velodyne-vlp-16")
    if not find_spec("kiss_icp"):
        print("not measured: kiss-icp is not installed")
        return
    for kind, seed in itertools.product(given.kinds, range(given.seeds)):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "log.mcap")
            words = (
                f"scan {kind} --seed {seed} --flight --sequence --length {given.length} --speed "
                f"{given.speed} --lidar {given.lidar} --noise datasheet --quiet "
                f"{'--moving' * given.moving}"
            )
            measuring.command(words, "-o", path)
            for voxel_m in given.voxels:
                print(
                    f"{kind:10} {seed}  {voxel_m} m  {_measured(path, given.moving, voxel_m)}",
                    flush=True,
                )


def _measured(path: Path, moving: bool, voxel_m: float) -> str:
    """KISS-ICP's errors on a log, in words."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP
    from kiss_icp.metrics import sequence_error

    config, log = KISSConfig(), read_log(path)
    config.data.deskew, config.mapping.voxel_size = moving, voxel_m
    odometry, found = KissICP(config), []
    for scan in log.scans():
        # of a sensor that stands still while it scans, a log has no times
        odometry.register_frame(scan.points, scan.more.get("t", np.zeros(len(scan.points))))
        found.append(odometry.last_pose)
    truth = np.array([matrix_of(pose) for pose in log.poses])
    metres = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum()
    share, turn = sequence_error(truth, np.array(found))
    return f"{metres:.0f} m  {len(truth)} scans  {share:.3f} %  {turn:.5f} °/m"


if __name__ == "__main__":
    main()
