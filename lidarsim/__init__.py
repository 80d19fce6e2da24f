"""LiDAR simulation: an MJCF world and a pose become rays, a scan, and observed and free voxels.

The whole method in five lines, on any MuJoCo world::

    model = mujoco.MjModel.from_xml_path("scenes/warehouse.xml")
    pose = Pose.level(position=(8.0, 6.0, 1.5), yaw_rad=0.3)
    scan = cast(AnalyticEngine.of(model), Lidar(), pose)
    grid = voxelize(scan, GridSpec())
    print(len(scan.points()), "returns in", grid.observed.sum(), "voxels")"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lidarsim.attachment import Attached, attach
    from lidarsim.engines import Engine
    from lidarsim.engines.analytic import AnalyticEngine
    from lidarsim.engines.mujoco import MujocoEngine
    from lidarsim.fusion import Fusion
    from lidarsim.grid import GridSpec
    from lidarsim.pose import Pose
    from lidarsim.scan import Scan, cast
    from lidarsim.sensors import Sensor
    from lidarsim.sensors.raster import Lidar
    from lidarsim.sensors.table import BeamTable
    from lidarsim.voxelization import ObservedGrid, fuse, voxelize

__all__ = [
    "AnalyticEngine",
    "Attached",
    "BeamTable",
    "Engine",
    "Fusion",
    "GridSpec",
    "Lidar",
    "MujocoEngine",
    "ObservedGrid",
    "Pose",
    "Scan",
    "Sensor",
    "attach",
    "cast",
    "fuse",
    "voxelize",
]


_MODULES = {
    "attachment": "Attached attach",
    "engines": "Engine",
    "engines.analytic": "AnalyticEngine",
    "engines.mujoco": "MujocoEngine",
    "fusion": "Fusion",
    "grid": "GridSpec",
    "pose": "Pose",
    "scan": "Scan cast",
    "sensors": "Sensor",
    "sensors.raster": "Lidar",
    "sensors.table": "BeamTable",
    "voxelization": "ObservedGrid fuse voxelize",
}


def __dir__() -> list[str]:
    return __all__


def __getattr__(name: str) -> Any:
    """Import a name of `__all__` on first use.

    The command line needs only `lidarsim.parameters`, and must not load numpy and MuJoCo for it."""
    for module, names in _MODULES.items():
        if name in names.split():
            attribute = getattr(importlib.import_module(f"lidarsim.{module}"), name)
            # so that the next access does not come here
            globals()[name] = attribute
            return attribute
    raise AttributeError(f"module 'lidarsim' has no attribute {name!r}")
