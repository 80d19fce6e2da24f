"""What a sensor sees: an MJCF world and a pose become rays, a scan, and observed and free voxels.

The whole method in five lines, on any MuJoCo world::

    model = mujoco.MjModel.from_xml_path("scenes/warehouse.xml")
    pose = Pose.level(position=(8.0, 6.0, 1.5), yaw_rad=0.3)
    scan = cast(MujocoCaster(model), Lidar(), pose)
    grid = voxelize(scan, GridSpec())
    print(len(scan.points()), "returns in", grid.observed.sum(), "voxels")
"""

from typing import TYPE_CHECKING, Any

from lidarsim.grid import GridSpec
from lidarsim.lidar import Lidar
from lidarsim.pose import Pose
from lidarsim.scan import Scan, cast
from lidarsim.voxelize import ObservedGrid, voxelize

if TYPE_CHECKING:
    from lidarsim.casters import Caster, MujocoCaster

__all__ = ["Caster", "GridSpec", "Lidar", "MujocoCaster", "ObservedGrid", "Pose", "Scan", "cast", "voxelize"]


def __getattr__(name: str) -> Any:
    """Engines are imported when they are asked for: MuJoCo takes longer than everything else here together."""
    if name not in ("Caster", "MujocoCaster"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from lidarsim import casters

    return getattr(casters, name)
