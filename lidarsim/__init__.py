"""What a sensor sees: an MJCF world and a pose become rays, a scan, and observed and free voxels.

The whole method in five lines, on any MuJoCo world::

    model = mujoco.MjModel.from_xml_path("scenes/warehouse.xml")
    pose = Pose.level(position=(8.0, 6.0, 1.5), yaw_rad=0.3)
    scan = cast(MujocoCaster(model), Lidar(), pose)
    grid = voxelize(scan, GridSpec())
    print(len(scan.points()), "returns in", grid.observed.sum(), "voxels")
"""

from lidarsim.casters import Caster, MujocoCaster
from lidarsim.grid import GridSpec
from lidarsim.lidar import Lidar
from lidarsim.pose import Pose
from lidarsim.scan import Scan, cast
from lidarsim.voxelize import ObservedGrid, voxelize

__all__ = ["Caster", "GridSpec", "Lidar", "MujocoCaster", "ObservedGrid", "Pose", "Scan", "cast", "voxelize"]
