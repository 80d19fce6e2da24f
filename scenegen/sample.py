"""One sample: the record, which is also the schema on disk, and what of it follows from the
rest."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lidarsim import Fusion, GridSpec, Pose, Scan, Sensor, fuse
from lidarsim.pose import rotate
from scenegen.truth import distance_field


def _stored(dtype: str, axes: str, meaning: str, *, unit: str = "", derived: bool = False) -> Any:
    """A field of the record: its type on disk, its axes (`grid`, `rays`, `earlier` scans, a count,
    or none), what it means, its unit (nothing for a count, a flag or a ratio), and whether it
    follows from the other fields."""
    return field(
        metadata={
            "dtype": dtype,
            "axes": axes,
            "unit": unit,
            "meaning": meaning,
            "derived": derived,
        }
    )


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Sample:
    """What was seen and what was there. Grids are indexed x, y, z; lengths are metres; positions in
    the world.

    What each field means stands in its metadata, once for readers, cards and this code alike.
    """

    observed: NDArray[np.bool_] = _stored("bool", "grid", "voxels that hold at least one return")
    free: NDArray[np.bool_] = _stored(
        "bool", "grid", "voxels, less the observed ones, that a ray met on its way", derived=True
    )
    occupancy: NDArray[np.bool_] = _stored(
        "bool",
        "grid",
        "truth: voxels whose closed cube touches a solid, or its surface where the grid is hollow",
    )
    tudf: NDArray[np.float32] = _stored(
        "<f4",
        "grid",
        "truth: distance from the voxel's centre to the nearest occupied voxel's centre in the "
        "map, truncated",
        unit="m",
        derived=True,
    )
    ranges: NDArray[np.float32] = _stored(
        "<f4", "rays", "distance along each ray; inf where nothing returned", unit="m"
    )
    position: NDArray[np.float64] = _stored(
        "<f8", "3", "of the sensor in the world: x, y, z", unit="m"
    )
    quaternion: NDArray[np.float64] = _stored(
        "<f8", "4", "the body's attitude in the world: w, x, y, z"
    )
    origin: NDArray[np.float64] = _stored(
        "<f8", "3", "the grid's least corner in the world: x, y, z", unit="m"
    )
    world: int = _stored("<i8", "", "the world's number within its split")
    viewpoint: int = _stored("<i8", "", "the sample's place among its world's accepted viewpoints")

    def points(
        self, lidar: Sensor | None = None, *, frame: Literal["world", "body"] = "world"
    ) -> NDArray[np.float64]:
        """The returns (M, 3) of all its scans, in their order and in ray order, metres, in the
        world or in the body's frame, which is that of the sample's own scan.

        A sample of a dataset knows its sensor; another needs `lidar`, and raises TypeError without
        it.
        """
        own, *earlier = self.scans(lidar)
        if frame == "world":
            return np.concatenate([scan.points() for scan in (own, *earlier)])
        hit, back = np.isfinite(self.ranges), self.quaternion * (1.0, -1.0, -1.0, -1.0)
        first = self.ranges[hit].astype(np.float64)[:, None] * own.lidar.directions_body[hit]
        return np.concatenate(
            [first, *(rotate(back, scan.points() - self.position) for scan in earlier)]
        )

    def scans(self, lidar: Sensor | None = None) -> list[Scan]:
        """The scans that its map is made of: its own, and then those before it, the last made
        first. See `points`."""
        lidar = lidar if lidar is not None else self._sensor()
        if lidar is None:
            raise TypeError(
                "points() and scans() need the sensor that made this sample, such as recipe.lidar"
            )
        earlier = zip(*(getattr(self, name) for name in EARLIER if name in self.names), strict=True)
        views = [(self.ranges, self.position, self.quaternion), *earlier]
        return [Scan(ranges, Pose(*pose), lidar) for ranges, *pose in views]

    @property
    def names(self) -> tuple[str, ...]:
        """Its fields."""
        return tuple(item.name for item in fields(self))

    def _sensor(self) -> Sensor | None:
        """The sensor that made the sample, where it is known."""
        return None

    def __repr__(self) -> str:
        shares = ", ".join(
            f"{name} {100 * getattr(self, name).mean():.1f} %" for name in ("observed", "occupancy")
        )
        grid = " × ".join(map(str, self.occupancy.shape))
        return f"<Sample: world {self.world}, viewpoint {self.viewpoint}, {grid} voxels, {shares}>"

    def _repr_html_(self) -> str:
        """For notebooks: each field with its shape, its share or value, and its meaning."""
        rows = []
        for name in self.names:
            about, value = FIELDS[name], np.asarray(getattr(self, name))
            said = (
                f"{100 * value.mean():.2f} %"
                if value.dtype == bool
                else str(value)
                if value.size <= 4
                else ""
            )
            rows.append(
                f"<tr><td>{name}</td><td>{value.shape}</td><td>{said}</td>"
                f"<td>{about['meaning']}</td></tr>"
            )
        return f"<table>{''.join(rows)}</table>"

    def sha256(self) -> bytes:
        """The sample's own digest (32 bytes), over what does not follow from the rest: see
        docs/format.md."""
        digest = hashlib.sha256()
        digest.update(np.packbits(self.observed).tobytes())
        digest.update(np.packbits(self.occupancy).tobytes())
        for name in ("ranges", "position", "quaternion", "origin", "world", "viewpoint"):
            digest.update(np.asarray(getattr(self, name), dtype=SCHEMA[name]["dtype"]).tobytes())
        return digest.digest()


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class EarlierScans(Sample):
    """A sample whose map is made of several scans: its own, and others before it, the last made
    first."""

    earlier_ranges: NDArray[np.float32] = _stored(
        "<f4", "earlier rays", "as `ranges`, of the scans before", unit="m"
    )
    earlier_position: NDArray[np.float64] = _stored(
        "<f8", "earlier 3", "of the sensor at each: x, y, z", unit="m"
    )
    earlier_quaternion: NDArray[np.float64] = _stored(
        "<f8", "earlier 4", "the body's attitude at each: w, x, y, z"
    )

    def sha256(self) -> bytes:
        """The sample's own digest (32 bytes): that without earlier scans, and these."""
        return _digest_with(super().sha256(), self, EARLIER)


@dataclass(frozen=True, eq=False, kw_only=True)
class LabelledSample(Sample):
    """A sample of a dataset with labels: which geom of its world each return and each voxel is of,
    and of which class.

    Geoms are numbered as in the compiled world; classes as the manifest's `labels` lists them.
    """

    return_geom: NDArray[np.int32] = _stored(
        "<i4", "rays", "the geom that each ray met; -1 where nothing returned"
    )
    return_class: NDArray[np.uint16] = _stored("<u2", "rays", "its class; 0 where nothing returned")
    voxel_geom: NDArray[np.int32] = _stored(
        "<i4",
        "grid",
        "truth: the geom that holds the voxel's centre, or is nearest to it; -1 where not occupied",
    )
    voxel_class: NDArray[np.uint16] = _stored(
        "<u2", "grid", "truth: its class; 0 where not occupied"
    )

    def sha256(self) -> bytes:
        """The sample's own digest (32 bytes): that without labels, and the labels."""
        return _digest_with(super().sha256(), self, LABELS)


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class LabelledEarlierScans(LabelledSample, EarlierScans):
    """A sample with labels, of its own scan and its map, and with earlier scans."""


def _digest_with(digest: bytes, sample: Sample, names: Mapping[str, Any]) -> bytes:
    """A digest over another one and the fields `names` of a sample."""
    found = hashlib.sha256(digest)
    for name, meta in names.items():
        found.update(np.asarray(getattr(sample, name), dtype=meta["dtype"]).tobytes())
    return found.digest()


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

    def __reduce__(self) -> tuple[Any, ...]:
        return whole, ({name: getattr(self, name) for name in self.names},)


def whole(values: Mapping[str, Any]) -> Sample:
    """The sample that has these values of its fields, with labels and earlier scans where they are
    among them."""
    labelled, earlier = values.keys() >= LABELS.keys(), values.keys() >= EARLIER.keys()
    kinds = {
        (False, False): Sample,
        (False, True): EarlierScans,
        (True, False): LabelledSample,
        (True, True): LabelledEarlierScans,
    }
    return kinds[labelled, earlier](**values)


def earlier_fields(scans: Sequence[Scan]) -> dict[str, NDArray[Any]]:
    """The fields of a sample that hold the scans before its own, the last made first; none where
    there is none."""
    if not scans:
        return {}
    values = zip(
        *((scan.ranges, scan.pose.position, scan.pose.quaternion) for scan in scans), strict=True
    )
    return {name: np.array(value) for name, value in zip(EARLIER, values, strict=True)}


SCHEMA = {item.name: item.metadata for item in fields(Sample)}
"""Name of every field on disk, in order, to its `dtype`, `axes`, `unit`, `meaning` and whether it
is `derived`."""


EARLIER = {item.name: item.metadata for item in fields(EarlierScans) if item.name not in SCHEMA}
"""The same of what a dataset with several scans a sample stores besides."""
LABELS = {item.name: item.metadata for item in fields(LabelledSample) if item.name not in SCHEMA}
"""The same of what a dataset with labels stores besides."""
FIELDS = SCHEMA | EARLIER | LABELS


def fields_of(scans: int, *, labels: bool) -> tuple[str, ...]:
    """Names of all fields of a sample of so many scans."""
    return (*SCHEMA, *(EARLIER if scans > 1 else ()), *(LABELS if labels else ()))


def stored_fields(compact: bool, labels: bool = False, scans: int = 1) -> tuple[str, ...]:
    """Names of the fields that a dataset stores."""
    return tuple(
        name
        for name in fields_of(scans, labels=labels)
        if not (compact and FIELDS[name]["derived"])
    )


def shape_of(name: str, grid: GridSpec, lidar: Sensor, scans: int = 1) -> tuple[int, ...]:
    """Shape of the field `name` of one sample of so many scans."""
    named: dict[str, tuple[int, ...]] = {
        "grid": grid.shape,
        "rays": lidar.shape,
        "earlier": (scans - 1,),
    }
    axes = FIELDS[name]["axes"].split()
    return tuple(
        count for axis in axes for count in (named[axis] if axis in named else (int(axis),))
    )


def describe_fields(
    grid: GridSpec, lidar: Sensor, *, labels: bool = False, scans: int = 1
) -> dict[str, dict[str, Any]]:
    """Every field of a sample of so many scans, with or without `labels`: name to its numpy
    `dtype`, `shape`, `unit` ("" for none), and `meaning`."""
    return {
        name: {
            "dtype": np.dtype(FIELDS[name]["dtype"]).name,
            "shape": shape_of(name, grid, lidar, scans),
            "unit": FIELDS[name]["unit"],
            "meaning": FIELDS[name]["meaning"],
        }
        for name in fields_of(scans, labels=labels)
    }


def derive_free(
    scans: Sequence[Scan], origin: NDArray[np.float64], *, grid: GridSpec, fusion: Fusion
) -> NDArray[np.bool_]:
    """The `free` of a sample from its stored `scans`, see `Sample.scans`, and its origin (3,), bit
    for bit."""
    return fuse(scans[::-1], grid, origin, fusion).free


def derive_tudf(occupancy: NDArray[np.bool_], *, grid: GridSpec) -> NDArray[np.float32]:
    """The `tudf` of a sample from its occupancy, bit for bit."""

    return distance_field(occupancy, grid)
