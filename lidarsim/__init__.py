"""What a sensor sees: an MJCF world and a pose become rays, a scan, and observed and free voxels.

The whole method in five lines, on any MuJoCo world::

    model = mujoco.MjModel.from_xml_path("scenes/warehouse.xml")
    pose = Pose.level(position=(8.0, 6.0, 1.5), yaw_rad=0.3)
    scan = cast(MujocoCaster(model), Lidar(), pose)
    grid = voxelize(scan, GridSpec())
    print(len(scan.points()), "returns in", grid.observed.sum(), "voxels")
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lidarsim.casters import Caster, MujocoCaster
    from lidarsim.grid import GridSpec
    from lidarsim.lidar import Lidar
    from lidarsim.pose import Pose
    from lidarsim.scan import Scan, cast
    from lidarsim.voxelize import ObservedGrid, voxelize

__all__ = ["Caster", "GridSpec", "Lidar", "MujocoCaster", "ObservedGrid", "Pose", "Scan", "cast", "voxelize"]

_PLACES = {
    "casters": ("Caster", "MujocoCaster"),
    "grid": ("GridSpec",),
    "lidar": ("Lidar",),
    "pose": ("Pose",),
    "scan": ("Scan", "cast"),
    "voxelize": ("ObservedGrid", "voxelize"),
}


def __getattr__(name: str) -> Any:
    """What `__all__` lists, imported when it is first asked for: `lidarsim.parameters` alone loads neither MuJoCo nor
    numba."""
    for module, names in _PLACES.items():
        if name in names:
            found = importlib.import_module(f"lidarsim.{module}")
            globals().update({each: getattr(found, each) for each in names})  # of `voxelize`, the function stays
            return globals()[name]
    raise AttributeError(f"module 'lidarsim' has no attribute {name!r}")
