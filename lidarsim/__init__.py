"""What a sensor sees: an MJCF world and a pose become rays, a scan, and observed and free voxels.

The whole method in five lines, on any MuJoCo world::

    model = mujoco.MjModel.from_xml_path("scenes/warehouse.xml")
    pose = Pose.level(position=(8.0, 6.0, 1.5), yaw_rad=0.3)
    scan = cast(MujocoEngine.of(model), Lidar(), pose)
    grid = voxelize(scan, GridSpec())
    print(len(scan.points()), "returns in", grid.observed.sum(), "voxels")
"""

from typing import TYPE_CHECKING, Any

from lidarsim.engines import Engine
from lidarsim.engines.analytic import AnalyticEngine
from lidarsim.grid import GridSpec
from lidarsim.pose import Pose
from lidarsim.scan import Scan, cast
from lidarsim.sensors import Sensor
from lidarsim.sensors.raster import Lidar
from lidarsim.sensors.table import BeamTable
from lidarsim.voxelize import ObservedGrid, voxelize

if TYPE_CHECKING:
    from lidarsim.engines.mujoco import MujocoEngine

__all__ = [
    "AnalyticEngine",
    "BeamTable",
    "Engine",
    "GridSpec",
    "Lidar",
    "MujocoEngine",
    "ObservedGrid",
    "Pose",
    "Scan",
    "Sensor",
    "cast",
    "voxelize",
]


def __getattr__(name: str) -> Any:
    """MuJoCo is imported when its engine is asked for: it takes longer than everything else here together."""
    if name != "MujocoEngine":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from lidarsim.engines.mujoco import MujocoEngine

    return MujocoEngine
