"""How far odometry errs on simulated logs, a log of each kind of worlds: KISS-ICP (Vizzo et al.
2023), which knows nothing of scenegen, or `scenegen ingest --align`. Needs `pip install kiss-icp`.

    python benchmarks/odometry.py pillar forest --seeds 3
    python benchmarks/odometry.py pillar forest --seeds 3 --align
    python benchmarks/odometry.py pillar --moving
    python benchmarks/odometry.py rooms --voxels 1 0.3 --speed 1.5

Per kind and seed: metres flown, scans, and for each edge of the voxels of KISS-ICP's map the mean
error of relative translation, %, and rotation, degrees a metre, as KITTI's odometry counts them:
over all ways of 100, 200 … 800 m. Its own choice is a hundredth of the sensor's range. With
--align, instead of voxels: what `ingest` says of the drift that it cannot know.
"""

import itertools
import tempfile
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import measuring
import numpy as np
from tyro.conf import Positional

from lidarsim.grid import Floats
from scenegen.base.errors import DatasetError
from scenegen.logs import Fusing
from scenegen.logs.align import align
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
    align: bool = False
    """measure `ingest --align`, with --deskew if --moving"""
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
            if given.align:
                print(f"{kind:10} {seed}  {_aligned(path, given.moving)}", flush=True)
                continue
            for voxel_m in given.voxels:
                print(
                    f"{kind:10} {seed}  {voxel_m} m  {_measured(path, given.moving, voxel_m)}",
                    flush=True,
                )


def _measured(path: Path, moving: bool, voxel_m: float) -> str:
    """KISS-ICP's errors on a log, in words."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    config, log = KISSConfig(), read_log(path)
    config.data.deskew, config.mapping.voxel_size = moving, voxel_m
    odometry, found = KissICP(config), []
    for scan in log.scans():
        # of a sensor that stands still while it scans, a log has no times
        odometry.register_frame(scan.points, scan.more.get("t", np.zeros(len(scan.points))))
        found.append(odometry.last_pose)
    return _errors(np.array([matrix_of(pose) for pose in log.poses]), np.array(found))


def _aligned(path: Path, moving: bool) -> str:
    """The errors of `ingest --align` on a log, and what it tells of itself."""
    try:
        log = align(read_log(path, posed=False), Fusing(deskew=moving))
    except DatasetError as error:
        return f"refused: {error}"
    true = read_log(path)
    known = dict(zip(true.times_s.tolist(), true.poses, strict=True))
    truth = np.array([matrix_of(known[time]) for time in log.times_s.tolist()])
    told = "  ".join(log.about[name] for name in ("failed", "inliers", "closing"))
    return f"{_errors(truth, np.array([matrix_of(pose) for pose in log.poses]))}  {told}"


def _errors(truth: Floats, found: Floats) -> str:
    from kiss_icp.metrics import sequence_error

    metres = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum()
    share, turn = sequence_error(truth, found)
    return f"{metres:.0f} m  {len(truth)} scans  {share:.3f} %  {turn:.5f} °/m"


if __name__ == "__main__":
    main()
