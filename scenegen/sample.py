"""One sample: the record, which is also the schema on disk, and what of it follows from the rest."""

import hashlib
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim import GridSpec, Lidar, Pose, Scan, voxelize
from scenegen.truth import distance_field


def _stored(dtype: str, axes: str, *, derived: bool = False) -> Any:
    """A field of the record: its type on disk, its shape (`grid`, `rays`, a count or nothing), and whether it follows
    from the other fields."""
    return field(metadata={"dtype": dtype, "axes": axes, "derived": derived})


@dataclass(frozen=True, eq=False, kw_only=True)
class Sample:
    """What one scan saw and what was there. Grids are indexed x, y, z; lengths are metres; positions in the world."""

    observed: NDArray[np.bool_] = _stored("bool", "grid")
    """Voxels that hold at least one return."""
    free: NDArray[np.bool_] = _stored("bool", "grid", derived=True)
    """Voxels, less `observed`, that a ray met on its way."""
    occupancy: NDArray[np.bool_] = _stored("bool", "grid")
    """Voxels whose closed cube touches a solid."""
    tudf: NDArray[np.float32] = _stored("<f4", "grid", derived=True)
    """Distance to the nearest occupied voxel's centre, truncated."""
    ranges: NDArray[np.float32] = _stored("<f4", "rays")
    """Metres along each ray; inf where nothing returned."""
    position: NDArray[np.float64] = _stored("<f8", "3")
    """Of the sensor."""
    quaternion: NDArray[np.float64] = _stored("<f8", "4")
    """Body attitude, w x y z."""
    origin: NDArray[np.float64] = _stored("<f8", "3")
    """The grid's least corner."""
    world: int = _stored("<i8", "")
    """The world's number within its split."""
    viewpoint: int = _stored("<i8", "")
    """The sample's place among its world's accepted viewpoints."""

    def sha256(self) -> bytes:
        """The sample's own digest (32 bytes), over what does not follow from the rest: see docs/format.md."""
        digest = hashlib.sha256()
        digest.update(np.packbits(self.observed).tobytes())
        digest.update(np.packbits(self.occupancy).tobytes())
        for name in ("ranges", "position", "quaternion", "origin", "world", "viewpoint"):
            digest.update(np.asarray(getattr(self, name), dtype=SCHEMA[name]["dtype"]).tobytes())
        return digest.digest()


SCHEMA = {item.name: item.metadata for item in fields(Sample)}
"""Name of every field on disk, in order, to its `dtype`, `axes` and whether it is `derived`."""


def shape_of(name: str, grid: GridSpec, lidar: Lidar) -> tuple[int, ...]:
    """Shape of one sample's field `name`."""
    axes = SCHEMA[name]["axes"]
    named: dict[str, tuple[int, ...]] = {"grid": grid.shape, "rays": (lidar.rows, lidar.columns), "": ()}
    return named[axes] if axes in named else (int(axes),)


def derive_free(
    ranges: NDArray[np.float32],
    position: NDArray[np.float64],
    quaternion: NDArray[np.float64],
    origin: NDArray[np.float64],
    *,
    lidar: Lidar,
    grid: GridSpec,
) -> NDArray[np.bool_]:
    """The `free` of a sample from its stored ranges (rows, columns), pose and origin, bit for bit."""
    return voxelize(Scan(ranges, Pose(position, quaternion), lidar), grid, origin).free


def derive_tudf(occupancy: NDArray[np.bool_], *, grid: GridSpec) -> NDArray[np.float32]:
    """The `tudf` of a sample from its occupancy, bit for bit."""
    return distance_field(occupancy, grid)
