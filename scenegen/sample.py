"""One sample: the record, which is also the schema on disk, and what of it follows from the rest."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lidarsim import GridSpec, Pose, Scan, Sensor, voxelize
from scenegen.truth import distance_field


def _stored(dtype: str, axes: str, meaning: str, *, unit: str = "", derived: bool = False) -> Any:
    """A field of the record: its type on disk, its shape (`grid`, `rays`, a count or nothing), what it means, its unit
    (nothing for a count, a flag or a ratio), and whether it follows from the other fields."""
    return field(metadata={"dtype": dtype, "axes": axes, "unit": unit, "meaning": meaning, "derived": derived})


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Sample:
    """What one scan saw and what was there. Grids are indexed x, y, z; lengths are metres; positions in the world.

    What each field means stands in its metadata, once for readers, cards and this code alike.
    """

    observed: NDArray[np.bool_] = _stored("bool", "grid", "voxels that hold at least one return")
    free: NDArray[np.bool_] = _stored(
        "bool", "grid", "voxels, less the observed ones, that a ray met on its way", derived=True
    )
    occupancy: NDArray[np.bool_] = _stored("bool", "grid", "truth: voxels whose closed cube touches a solid")
    tudf: NDArray[np.float32] = _stored(
        "<f4",
        "grid",
        "truth: distance from the voxel's centre to the nearest occupied voxel's centre in the map, truncated",
        unit="m",
        derived=True,
    )
    ranges: NDArray[np.float32] = _stored(
        "<f4", "rays", "distance along each ray; inf where nothing returned", unit="m"
    )
    position: NDArray[np.float64] = _stored("<f8", "3", "of the sensor in the world: x, y, z", unit="m")
    quaternion: NDArray[np.float64] = _stored("<f8", "4", "the body's attitude in the world: w, x, y, z")
    origin: NDArray[np.float64] = _stored("<f8", "3", "the grid's least corner in the world: x, y, z", unit="m")
    world: int = _stored("<i8", "", "the world's number within its split")
    viewpoint: int = _stored("<i8", "", "the sample's place among its world's accepted viewpoints")

    def points(self, lidar: Sensor | None = None, *, frame: Literal["world", "body"] = "world") -> NDArray[np.float64]:
        """The returns (M, 3) in ray order, metres, in the world or in the body's frame.

        A sample of a dataset knows its sensor; another needs `lidar`, and raises TypeError without it.
        """
        lidar = lidar if lidar is not None else self._sensor()
        if lidar is None:
            raise TypeError("points() needs the sensor that made this sample, such as recipe.lidar")
        if frame == "world":
            return Scan(self.ranges, Pose(self.position, self.quaternion), lidar).points()
        hit = np.isfinite(self.ranges)
        return self.ranges[hit].astype(np.float64)[:, None] * lidar.directions_body[hit]

    def _sensor(self) -> Sensor | None:
        """The sensor that made the sample, where it is known."""
        return None

    def __repr__(self) -> str:
        shares = ", ".join(f"{name} {100 * getattr(self, name).mean():.1f} %" for name in ("observed", "occupancy"))
        grid = " × ".join(map(str, self.occupancy.shape))
        return f"<Sample: world {self.world}, viewpoint {self.viewpoint}, {grid} voxels, {shares}>"

    def _repr_html_(self) -> str:
        """For notebooks: each field with its shape, its share or value, and its meaning."""
        rows = []
        for name, about in SCHEMA.items():
            value = np.asarray(getattr(self, name))
            said = f"{100 * value.mean():.2f} %" if value.dtype == bool else str(value) if value.size <= 4 else ""
            rows.append(f"<tr><td>{name}</td><td>{value.shape}</td><td>{said}</td><td>{about['meaning']}</td></tr>")
        return f"<table>{''.join(rows)}</table>"

    def sha256(self) -> bytes:
        """The sample's own digest (32 bytes), over what does not follow from the rest: see docs/format.md."""
        digest = hashlib.sha256()
        digest.update(np.packbits(self.observed).tobytes())
        digest.update(np.packbits(self.occupancy).tobytes())
        for name in ("ranges", "position", "quaternion", "origin", "world", "viewpoint"):
            digest.update(np.asarray(getattr(self, name), dtype=SCHEMA[name]["dtype"]).tobytes())
        return digest.digest()


@dataclass(frozen=True, eq=False, kw_only=True)
class LabelledSample(Sample):
    """A sample of a dataset with labels: which geom of its world each return and each voxel is of, and of which class.

    Geoms are numbered as in the compiled world; classes as the manifest's `labels` lists them.
    """

    return_geom: NDArray[np.int32] = _stored("<i4", "rays", "the geom that each ray met; -1 where nothing returned")
    return_class: NDArray[np.uint16] = _stored("<u2", "rays", "its class; 0 where nothing returned")
    voxel_geom: NDArray[np.int32] = _stored(
        "<i4", "grid", "truth: the geom that holds the voxel's centre, or is nearest to it; -1 where not occupied"
    )
    voxel_class: NDArray[np.uint16] = _stored("<u2", "grid", "truth: its class; 0 where not occupied")

    def sha256(self) -> bytes:
        """The sample's own digest (32 bytes): that without labels, and the labels."""
        digest = hashlib.sha256(super().sha256())
        for name, meta in LABELS.items():
            digest.update(np.asarray(getattr(self, name), dtype=meta["dtype"]).tobytes())
        return digest.digest()


class LazySample(Sample):
    """A sample each field of which is found when it is first asked for, and then kept.

    A copy, pickled or not, is a plain `Sample` with all its fields.
    """

    def find(self, name: str) -> Any:
        """The value of a field of the schema."""
        raise NotImplementedError

    def __getattr__(self, name: str) -> Any:
        if name not in FIELDS or name not in self.names:
            raise AttributeError(f"a sample has no field {name!r}; it has {', '.join(SCHEMA)}")
        return self.__dict__.setdefault(name, self.find(name))

    @property
    def names(self) -> tuple[str, ...]:
        """Its fields."""
        return tuple(SCHEMA)

    def __reduce__(self) -> tuple[Any, ...]:
        return whole, ({name: getattr(self, name) for name in self.names},)


def whole(values: Mapping[str, Any]) -> Sample:
    """The sample that has these values of its fields, with labels where they are among them."""
    return LabelledSample(**values) if values.keys() >= LABELS.keys() else Sample(**values)


SCHEMA = {item.name: item.metadata for item in fields(Sample)}
"""Name of every field on disk, in order, to its `dtype`, `axes`, `unit`, `meaning` and whether it is `derived`."""


LABELS = {item.name: item.metadata for item in fields(LabelledSample) if item.name not in SCHEMA}
"""The same of what a dataset with labels stores besides."""
FIELDS = SCHEMA | LABELS


def stored_fields(compact: bool, labels: bool = False) -> tuple[str, ...]:
    """Names of the fields that a dataset stores."""
    stored = tuple(name for name, meta in SCHEMA.items() if not (compact and meta["derived"]))
    return stored + tuple(LABELS) if labels else stored


def shape_of(name: str, grid: GridSpec, lidar: Sensor) -> tuple[int, ...]:
    """Shape of one sample's field `name`."""
    axes = FIELDS[name]["axes"]
    named: dict[str, tuple[int, ...]] = {"grid": grid.shape, "rays": lidar.shape, "": ()}
    return named[axes] if axes in named else (int(axes),)


def describe_fields(grid: GridSpec, lidar: Sensor, *, labels: bool = False) -> dict[str, dict[str, Any]]:
    """Every field of a sample, with or without `labels`: name to its numpy `dtype`, `shape`, `unit` ("" for none), and
    `meaning`."""
    return {
        name: {
            "dtype": np.dtype(meta["dtype"]).name,
            "shape": shape_of(name, grid, lidar),
            "unit": meta["unit"],
            "meaning": meta["meaning"],
        }
        for name, meta in (FIELDS if labels else SCHEMA).items()
    }


def derive_free(
    ranges: NDArray[np.float32],
    position: NDArray[np.float64],
    quaternion: NDArray[np.float64],
    origin: NDArray[np.float64],
    *,
    lidar: Sensor,
    grid: GridSpec,
) -> NDArray[np.bool_]:
    """The `free` of a sample from its stored ranges (*lidar.shape), pose and origin, bit for bit."""
    return voxelize(Scan(ranges, Pose(position, quaternion), lidar), grid, origin).free


def derive_tudf(occupancy: NDArray[np.bool_], *, grid: GridSpec) -> NDArray[np.float32]:
    """The `tudf` of a sample from its occupancy, bit for bit."""

    return distance_field(occupancy, grid)
