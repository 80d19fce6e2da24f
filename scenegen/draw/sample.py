"""One sample: its record, which is also the schema on disk; and how notebooks show it."""

import hashlib
import html
import math
import operator
import sys
from abc import abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, NoReturn, overload

import numpy as np
from numpy.typing import NDArray

from lidarsim import GridSpec, Pose, Scan, Sensor
from lidarsim.grid import Field, Floats, Mask
from lidarsim.parameters import short_repr
from scenegen.base.errors import DatasetError, lacking
from scenegen.worlds.traffic import MAX_MOVERS, MAX_PIECES, MAX_SOLIDS

if TYPE_CHECKING:
    from scenegen.draw.movers import SampleMotion
    from scenegen.draw.tensors import TensorSamples


def html_table(rows: Iterable[Sequence[object]], title: object) -> str:
    """Make an HTML table for notebooks. All text is escaped.

    Args:
        rows: Cells of each row.
        title: Text above the table.
    """
    lines = ("".join(f"<td>{html.escape(str(cell))}</td>" for cell in row) for row in rows)
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return f"<p>{html.escape(str(title))}</p><table>{body}</table>"


def _stored(
    dtype: str, axes: str, meaning: str, *, unit: str = "", derived: bool = False, group: str = ""
) -> Any:
    """Declare a field of the record.

    `axes` names `grid`, `rays`, `scans`, `earlier` (scans) or lengths; "" means a scalar. Readers,
    dataset cards and this code share `meaning`. `derived` fields can be computed from others.
    Fields of a `group` exist only in some datasets.
    """
    metadata: dict[str, Any] = {"dtype": dtype, "axes": axes, "unit": unit, "meaning": meaning}
    metadata |= {"derived": derived, "group": group}
    if not group:
        return field(metadata=metadata)
    # A factory: a plain default would be a class attribute, so that `__getattr__` of a lazy sample
    # would never be called.
    return field(metadata=metadata, default_factory=lambda: None)


# eq=False: arrays do not compare to one truth value, and caches need samples with a hash
@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Sample:
    """A sample: the observed map, its ground truth, and the scans.

    Grids are indexed x, y, z. Lengths are in metres, positions in the world's frame. Some fields
    are None in datasets without them: `earlier_…` belong to datasets with several scans a sample
    (latest first), `return_…` and `voxel_…` to labelled ones (geoms are numbered as in the compiled
    world, classes as in the recipe's `labels`), `return_normal` to those with normals, `known` and
    `ray_known` to those of maps of real places.

    Fields of a sample from a dataset or a stream are read on first access. A copy, by pickle or
    `dataclasses.replace`, holds all of them.
    """

    observed: Mask = _stored("bool", "grid", "voxels that hold at least one return")
    free: Mask = _stored(
        "bool", "grid", "voxels, less the observed ones, that a ray met on its way", derived=True
    )
    occupancy: Mask = _stored(
        "bool",
        "grid",
        "truth: voxels whose closed cube touches a solid, or its surface where the grid is hollow",
    )
    tudf: Field = _stored(
        "<f4",
        "grid",
        "truth: distance from the voxel's centre to the nearest occupied voxel's centre in the "
        "map, truncated",
        unit="m",
        derived=True,
    )
    ranges: Field = _stored(
        "<f4", "rays", "distance along each ray; inf where nothing returned", unit="m"
    )
    position: Floats = _stored("<f8", "3", "of the sensor in the world: x, y, z", unit="m")
    quaternion: Floats = _stored("<f8", "4", "the body's attitude in the world: w, x, y, z")
    origin: Floats = _stored("<f8", "3", "the grid's least corner in the world: x, y, z", unit="m")
    world: int = _stored("<i8", "", "the world's number within its split")
    viewpoint: int = _stored("<i8", "", "the sample's place among its world's accepted viewpoints")
    earlier_ranges: Field | None = _stored(
        "<f4", "earlier rays", "as `ranges`, of the scans before", unit="m", group="earlier"
    )
    earlier_position: Floats | None = _stored(
        "<f8", "earlier 3", "of the sensor at each: x, y, z", unit="m", group="earlier"
    )
    earlier_quaternion: Floats | None = _stored(
        "<f8", "earlier 4", "the body's attitude at each: w, x, y, z", group="earlier"
    )
    return_geom: NDArray[np.int32] | None = _stored(
        "<i4", "rays", "the geom that each ray met; -1 where nothing returned", group="labels"
    )
    return_class: NDArray[np.uint16] | None = _stored(
        "<u2", "rays", "its class; 0 where nothing returned", group="labels"
    )
    voxel_geom: NDArray[np.int32] | None = _stored(
        "<i4",
        "grid",
        "truth: the geom that holds the voxel's centre, or is nearest to it; -1 where not occupied",
        group="labels",
    )
    voxel_class: NDArray[np.uint16] | None = _stored(
        "<u2", "grid", "truth: its class; 0 where not occupied", group="labels"
    )
    return_normal: Field | None = _stored(
        "<f4",
        "rays 3",
        "the outward surface normal where each ray returned, in the world's frame; zeros where "
        "nothing returned",
        group="normals",
    )
    known: Mask | None = _stored(
        "bool",
        "grid",
        "voxels of which the map of the place knows whether they are occupied; of the others the "
        "truth says nothing",
        group="known",
    )
    ray_known: Mask | None = _stored(
        "bool",
        "rays",
        "rays that cross no more unknown space than `known.most_unknown_m` before they return",
        group="known",
    )
    scan_times: Floats | None = _stored(
        "<f8",
        "scans",
        "when each scan began, the sample's own first; courses of movers are functions of it",
        unit="s",
        group="movers",
    )
    course_end: float | None = _stored(
        "<f8", "", "until when courses of movers are stored", unit="s", group="movers"
    )
    static_occupancy: Mask | None = _stored(
        "bool", "grid", "truth: voxels that solids which stand still touch", group="movers"
    )
    voxel_mover: NDArray[np.int8] | None = _stored(
        "<i1",
        "grid",
        "truth: the mover that touches the voxel, the one of the smallest number if several do; -1 "
        "for none",
        group="movers",
    )
    return_mover: NDArray[np.int8] | None = _stored(
        "<i1", "rays", "the mover that each ray met; -1 for none, or no return", group="movers"
    )
    mover_kind: NDArray[np.int8] | None = _stored(
        "<i1",
        f"{MAX_MOVERS}",
        "kind of each mover: 1 person, 2 vehicle, 3 drone; 0 for unused rows",
        group="movers",
    )
    mover_solids: Floats | None = _stored(
        "<f8",
        f"{MAX_MOVERS} {MAX_SOLIDS} 7",
        "solids of each mover: MuJoCo's code of the shape, its three sizes, and its centre in the "
        "mover's frame (x ahead, z up); -1 in unused rows",
        unit="m",
        group="movers",
    )
    mover_course: Floats | None = _stored(
        "<f8",
        f"{MAX_MOVERS} {MAX_PIECES} 21",
        "pieces of each mover's course: when it begins, and four coefficients each, rising, of x, "
        "y, z and of the heading's x and y in the seconds since; NaN in unused rows",
        unit="s, m",
        group="movers",
    )
    lidar: Sensor | None = None
    """The sensor of the scans, if known."""
    grid: GridSpec | None = None
    """The map's grid, if known."""

    @classmethod
    def lazy(
        cls,
        names: Iterable[str],
        find: "Callable[[Sample, str], Any]",
        *,
        lidar: Sensor,
        grid: GridSpec,
    ) -> "Sample":
        """Make a sample whose fields are read on first access.

        Args:
            find: Called as find(sample, name), once for each of the fields `names`.
        """
        # Registers a clear error for torch's default collate. Torch is not imported for this: a
        # DataLoader has imported it before it reads a sample.
        collate = sys.modules.get("torch.utils.data._utils.collate")
        getattr(collate, "default_collate_fn_map", {}).setdefault(cls, _refuse_batch)
        # `__init__` would require the values of all fields
        sample = cls.__new__(cls)
        sample.__dict__.update(_names=tuple(names), _find=find, lidar=lidar, grid=grid)
        return sample

    def __getattr__(self, name: str) -> Any:
        known = self.__dict__
        # while a sample is copied or unpickled, `_find` is not set yet: fail instead of recursing
        if name not in FIELDS or "_find" not in known:
            raise AttributeError(f"a sample has no field {name!r}; it has {', '.join(FIELDS)}")
        value = known["_find"](self, name) if name in known["_names"] else None
        # setdefault: two threads that read a field get the same object
        return known.setdefault(name, value)

    def __dir__(self) -> list[str]:
        # fields that nobody has read yet are completed in notebooks, too
        return [*super().__dir__(), *FIELDS]

    def __getstate__(self) -> dict[str, Any]:
        return {item.name: getattr(self, item.name) for item in fields(self)}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its fields, in the order of the schema."""
        known: tuple[str, ...] | None = self.__dict__.get("_names")
        return known or tuple(name for name in FIELDS if getattr(self, name) is not None)

    def points(
        self, lidar: Sensor | None = None, *, frame: Literal["world", "body"] = "world"
    ) -> Floats:
        """Returns of all scans as points.

        Args:
            lidar: The sensor; by default the sample's own.
            frame: "world", or "body" for the frame of the body that carries the sensor, at the
                sample's latest scan.

        Returns:
            Points (M, 3) in metres, scan by scan as in `scans`, each in ray order.

        Raises:
            TypeError: if the sensor is not known.
            ValueError: if there is no such frame, or `lidar` does not fit the ranges.
        """
        if frame not in ("world", "body"):
            raise ValueError(f"frame = {frame!r}: expected 'world' or 'body'")
        latest, *earlier = self.scans(lidar)
        if frame == "world":
            return np.concatenate([scan.points() for scan in (latest, *earlier)])
        hit = np.isfinite(self.ranges)
        # directly from the ranges: through the world and back, points would be rounded twice
        first = self.ranges[hit].astype(np.float64)[:, None] * latest.lidar.directions_body[hit]
        return np.concatenate([first, *(latest.pose.to_body(scan.points()) for scan in earlier)])

    def scans(self, lidar: Sensor | None = None) -> list[Scan]:
        """All scans of the sample: its own, then earlier ones, latest first. By default with its
        own sensor.

        Raises:
            TypeError: if the sensor is not known.
            ValueError: if `lidar` does not fit the ranges.
        """
        if (lidar := lidar or self.lidar) is None:
            raise TypeError(
                "points() and scans() need the sensor that made this sample, such as recipe.lidar"
            )
        views = [(self.ranges, self.position, self.quaternion)]
        if self.earlier_ranges is not None:
            earlier = (getattr(self, name) for name in GROUPS["earlier"])
            views += zip(*earlier, strict=True)
        return [Scan(ranges, Pose(*pose), lidar) for ranges, *pose in views]

    @cached_property
    def motion(self) -> "SampleMotion":
        """What moves in the sample: occupancy, distances and velocities at other times.

        Raises:
            DatasetError: if it has no movers.
        """
        from scenegen.draw.movers import SampleMotion

        if self.grid is None:
            raise DatasetError("motion needs the sample's grid, such as recipe.grid")
        return SampleMotion(self, grid=self.grid)

    def __repr__(self) -> str:
        shares = ", ".join(
            f"{name} {100 * getattr(self, name).mean():.1f} %" for name in ("observed", "occupancy")
        )
        grid = " × ".join(map(str, self.occupancy.shape))
        return f"<Sample: world {self.world}, viewpoint {self.viewpoint}, {grid} voxels, {shares}>"

    def _repr_html_(self) -> str:
        """For notebooks: a table of fields with shape, share or value, and meaning."""
        rows = []
        for name in self.names:
            value, summary = np.asarray(getattr(self, name)), ""
            if value.dtype == bool:
                summary = f"{100 * value.mean():.2f} %"
            elif value.size <= 4:
                summary = str(value)
            rows.append((name, value.shape, summary, FIELDS[name]["meaning"]))
        return html_table(rows, self)

    def sha256(self) -> bytes:
        """Digest of the sample (32 bytes) over all fields that are not derived, as defined in
        docs/format.md."""
        digest = b""
        for group, names in GROUPS.items():
            # the fields of a group are present or absent together
            if getattr(self, names[0]) is None:
                continue
            group_hash = hashlib.sha256(digest)
            for name in (name for name in names if name not in DERIVED):
                # docs/format.md defines these bytes: other programs compute the digest, too
                values = np.asarray(getattr(self, name), FIELDS[name]["dtype"], order="C")
                # grids that every sample has count by their bits
                packed = values.dtype == bool and not group
                group_hash.update((np.packbits(values) if packed else values).data)
            # chained: samples without optional groups keep the digest of the format without these
            digest = group_hash.digest()
        return digest


FIELDS = {item.name: item.metadata for item in fields(Sample) if "dtype" in item.metadata}
"""Fields on disk, in order: name to `dtype`, `axes`, `unit`, `meaning`, `group` and `derived`."""
GROUPS = {
    group: tuple(name for name, entry in FIELDS.items() if entry["group"] == group)
    for group in dict.fromkeys(entry["group"] for entry in FIELDS.values())
}
"""Names of the fields of each group; "" is the group of all datasets."""
DERIVED = tuple(name for name, entry in FIELDS.items() if entry["derived"])
"""Fields that can be computed from others."""


@dataclass(frozen=True, kw_only=True)
class Schema:
    """Fields of a dataset's samples, and their shapes."""

    grid: GridSpec
    lidar: Sensor
    groups: tuple[str, ...] = ()
    """Groups of fields beyond those of all datasets."""
    scans: int = 1
    """Number of scans of a sample."""
    after_s: float = -math.inf
    """How long after a sample's time courses of its movers are stored, seconds; -inf without."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all fields, in order."""
        return tuple(name for name, entry in FIELDS.items() if entry["group"] in ("", *self.groups))

    def stored(self, *, compact: bool) -> tuple[str, ...]:
        """Names of the stored fields: all, or without derived ones if `compact`."""
        return tuple(name for name in self.names if not (compact and name in DERIVED))

    def shape(self, name: str) -> tuple[int, ...]:
        """Shape of a field of one sample."""
        lengths = {
            "grid": self.grid.shape,
            "rays": self.lidar.shape,
            "earlier": (self.scans - 1,),
            "scans": (self.scans,),
        }
        axes = FIELDS[name]["axes"].split()
        return tuple(
            count for axis in axes for count in (lengths[axis] if axis in lengths else (int(axis),))
        )

    def describe(self) -> dict[str, dict[str, Any]]:
        """Describe every field: name to numpy `dtype`, `shape`, `unit` ("" for none), `meaning`."""
        return {
            name: {
                "dtype": np.dtype(FIELDS[name]["dtype"]).name,
                "shape": self.shape(name),
                "unit": FIELDS[name]["unit"],
                "meaning": FIELDS[name]["meaning"],
            }
            for name in self.names
        }


def earlier_fields(scans: Sequence[Scan]) -> dict[str, np.ndarray]:
    """Fields of a sample for its earlier scans, latest first; {} if there are none."""
    if not scans:
        return {}
    values = zip(
        *((scan.ranges, scan.pose.position, scan.pose.quaternion) for scan in scans), strict=True
    )
    return {name: np.array(value) for name, value in zip(GROUPS["earlier"], values, strict=True)}


def _refuse_batch(batch: Any, *, collate_fn_map: Any = None) -> NoReturn:
    """Called by torch's default collate for a batch of samples."""
    raise TypeError(
        "torch's default collate cannot batch samples: give DataLoader `samples.torch()`, whose "
        "items are dictionaries of tensors, or a collate_fn of your own"
    )


def rng_of(seed: int, *key: int) -> np.random.Generator:
    """Random numbers of one part of some work, independent of those of other parts.

    Args:
        seed: Seed of the work.
        key: Numbers that identify the part.
    """
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))


class SampleSequence(Sequence[Sample]):
    """Samples by number: the common interface of a dataset's split and a stream."""

    @property
    @abstractmethod
    def schema(self) -> Schema:
        """Schema of the samples; of the first source if several differ."""

    @property
    def schemas(self) -> Sequence[Schema]:
        """Schemas of all sources."""
        return [self.schema]

    @abstractmethod
    def __getitems__(self, indices: Sequence[int]) -> list[Sample]:
        """Read several samples."""

    @overload
    def __getitem__(self, index: int) -> Sample: ...
    @overload
    def __getitem__(self, index: slice) -> list[Sample]: ...
    def __getitem__(self, index: int | slice) -> Sample | list[Sample]:
        if isinstance(index, slice):
            return self.__getitems__(range(*index.indices(len(self))))
        return self.__getitems__([index])[0]

    def _checked(self, index: Any) -> int:
        """Check an index, and count it from 0. Raises TypeError and IndexError."""
        number = operator.index(index)
        if not -len(self) <= number < len(self):
            raise IndexError(f"{self}: has no sample {short_repr(number)}")
        # negative indices count from the end
        return number % len(self)

    def torch(self, fields: Sequence[str] | None = None) -> "TensorSamples":
        """Make a map-style PyTorch dataset whose items are dictionaries of tensors:
        `DataLoader(samples.torch(), batch_size=8)` batches them. Shapes and types are those of
        `describe`, except that classes are int32.

        Args:
            fields: Names of the fields; all by default. Other fields are neither read nor derived.
                Of samples with movers also "moving", "flow", and "occupancy+0.5" or "tudf+0.5" for
                those half a second later; see `motion`.

        Raises:
            DatasetError: if a field does not exist, its shape differs between samples, or torch is
                not installed.
        """
        try:
            from scenegen.draw.tensors import tensors_of
        except ModuleNotFoundError as error:
            raise DatasetError(f"{self}: torch() {lacking(error) or error}") from None
        return tensors_of(self, fields)

    def describe(self) -> dict[str, dict[str, Any]]:
        """Describe the fields: name to `dtype`, `shape`, `unit` and `meaning`."""
        return self.schema.describe()

    def _repr_html_(self) -> str:
        """For notebooks: a table of the fields."""
        rows = ((name, *entry.values()) for name, entry in self.describe().items())
        return html_table(rows, self)
