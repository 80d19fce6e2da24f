"""One turn of the sensor: cast every ray, keep the ranges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lidarsim.lidar import Lidar
from lidarsim.pose import Pose

if TYPE_CHECKING:  # whoever casts has an engine imported; who reads a scan needs none
    from lidarsim.casters import Caster


@dataclass(frozen=True, eq=False)
class Scan:
    """What a LiDAR at a pose returned. `ranges` alone is measured: everything else about the rays follows."""

    ranges: NDArray[np.float32]
    """(rows, columns), metres along each ray; ``inf`` where nothing returned."""
    pose: Pose
    lidar: Lidar

    def points(self) -> NDArray[np.float64]:
        """The returns, (M, 3) in the world, in ray order."""
        hit = np.isfinite(self.ranges)
        directions = self.lidar.directions(self.pose.quaternion)[hit]
        return self.pose.position + self.ranges[hit].astype(np.float64)[:, None] * directions


def cast(caster: Caster, lidar: Lidar, pose: Pose) -> Scan:
    """Scan the caster's world with `lidar` carried by a body at `pose`."""
    ranges = caster.cast(pose.position, lidar.directions(pose.quaternion), lidar.max_range_m)
    return Scan(ranges.astype(np.float32), pose, lidar)
