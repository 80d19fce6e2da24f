"""One sample: the record, which is also the schema on disk, and what of it follows from the
rest.
"""

import hashlib
import html
import operator
import sys
from abc import abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any, Literal, NoReturn, overload

import numpy as np
from numpy.typing import NDArray

from lidarsim import GridSpec, Pose, Scan, Sensor
from lidarsim.grid import Field, Floats, Mask
from scenegen.base.errors import DatasetError, lacking, short

if TYPE_CHECKING:
    from scenegen.draw.tensors import TensorSamples


def _stored(
    dtype: str, axes: str, meaning: str, *, unit: str = "", derived: bool = False, group: str = ""
) -> Any:
    """A field of the record.

    Args:
        dtype: Its type on disk.
        axes: `grid`, `rays`, `earlier` scans, a count, or nothing for a single value.
        meaning: What it means, once for readers, cards and this code alike.
        unit: Its unit; nothing for a count, a flag or a ratio.
        derived: Whether it follows from the other fields.
        group: The group of fields that only some datasets have; nothing for a field of all.
    """
    about: dict[str, Any] = {"dtype": dtype, "axes": axes, "unit": unit, "meaning": meaning}
    about |= {"derived": derived, "group": group}
    if not group:
        return field(metadata=about)
    # a factory, since a default would be found on the class before a field is looked up
    return field(metadata=about, default_factory=lambda: None)


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Sample:
    """What was seen and what was there.

    Grids are indexed x, y, z; lengths are metres; positions are in the world's frame. A dataset
    with several scans a sample has the fields `earlier_…`, the last scan made first; one with
    labels has `return_…` and `voxel_…`, where geoms are numbered as in the compiled world and
    classes as in the recipe's `labels`; one with normals has `return_normal`; one of maps has
    `known` and `ray_known`. These fields are None in other datasets. The fields of a sample that
    comes from a dataset or a stream are read when they are first asked for; a copy of it, by pickle
    or by `dataclasses.replace`, holds all of them.
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
    lidar: Sensor | None = None
    """The sensor that made the sample, where it is known."""
    grid: GridSpec | None = None
    """The map's grid, where it is known."""

    @classmethod
    def lazy(
        cls,
        names: Iterable[str],
        find: "Callable[[Sample, str], Any]",
        *,
        lidar: Sensor,
        grid: GridSpec,
    ) -> "Sample":
        """The sample with the fields `names`, each of which `find` is asked for once."""
        # torch's own way to extend it; a loader has imported it before it reads a sample
        collate = sys.modules.get("torch.utils.data._utils.collate")
        getattr(collate, "default_collate_fn_map", {}).setdefault(cls, _refuse_batch)
        sample = cls.__new__(cls)
        sample.__dict__.update(_names=tuple(names), _find=find, lidar=lidar, grid=grid)
        return sample

    def __getattr__(self, name: str) -> Any:
        known = self.__dict__
        if name not in FIELDS or "_find" not in known:
            raise AttributeError(f"a sample has no field {name!r}; it has {', '.join(FIELDS)}")
        value = known["_find"](self, name) if name in known["_names"] else None
        return known.setdefault(name, value)

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *FIELDS]

    def __getstate__(self) -> dict[str, Any]:
        return {item.name: getattr(self, item.name) for item in fields(self)}

    @property
    def names(self) -> tuple[str, ...]:
        """The names of its fields, in the order of the schema."""
        known: tuple[str, ...] | None = self.__dict__.get("_names")
        return known or tuple(name for name in FIELDS if getattr(self, name) is not None)

    def points(
        self, lidar: Sensor | None = None, *, frame: Literal["world", "body"] = "world"
    ) -> Floats:
        """The returns of all its scans.

        Args:
            lidar: The sensor; the sample's own by default, if it knows it.
            frame: "world", or "body" for the frame of the body that holds the sensor at the
                sample's own scan.

        Returns:
            Points (M, 3) in metres, scan by scan as in `scans`, each in ray order.

        Raises:
            TypeError: The sensor is not known.
            ValueError: There is no such frame, or `lidar` is no sensor of these ranges.
        """
        if frame not in ("world", "body"):
            raise ValueError(f"frame = {frame!r}: expected 'world' or 'body'")
        own, *earlier = self.scans(lidar)
        if frame == "world":
            return np.concatenate([scan.points() for scan in (own, *earlier)])
        hit = np.isfinite(self.ranges)
        first = self.ranges[hit].astype(np.float64)[:, None] * own.lidar.directions_body[hit]
        return np.concatenate([first, *(own.pose.to_body(scan.points()) for scan in earlier)])

    def scans(self, lidar: Sensor | None = None) -> list[Scan]:
        """The scans that its map is made of: its own, and then those before it, the last made
        first; by its own sensor, if it knows it, unless `lidar` is given. Raises TypeError where
        neither is known, and ValueError for what is no sensor of its ranges."""
        if (lidar := lidar or self.lidar) is None:
            raise TypeError(
                "points() and scans() need the sensor that made this sample, such as recipe.lidar"
            )
        views = [(self.ranges, self.position, self.quaternion)]
        if self.earlier_ranges is not None:
            earlier = (getattr(self, name) for name in GROUPS["earlier"])
            views += zip(*earlier, strict=True)
        return [Scan(ranges, Pose(*pose), lidar) for ranges, *pose in views]

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
            value, said = np.asarray(getattr(self, name)), ""
            if value.dtype == bool:
                said = f"{100 * value.mean():.2f} %"
            elif value.size <= 4:
                said = str(value)
            rows.append((name, value.shape, said, FIELDS[name]["meaning"]))
        return html_table(rows, self)

    def sha256(self) -> bytes:
        """The sample's own digest (32 bytes) over what does not follow from the rest, as
        docs/format.md defines it."""
        digest = b""
        for group, names in GROUPS.items():
            if getattr(self, names[0]) is None:
                continue
            whole = hashlib.sha256(digest)
            for name in (name for name in names if name not in DERIVED):
                values = np.asarray(getattr(self, name), FIELDS[name]["dtype"])
                # grids that every sample has count by their bits
                packed = values.dtype == bool and not group
                whole.update((np.packbits(values) if packed else values).tobytes())
            digest = whole.digest()
        return digest


def html_table(rows: Iterable[Sequence[object]], title: object) -> str:
    """A table for notebooks under `title`; nothing in it is taken for HTML."""
    lines = ("".join(f"<td>{html.escape(str(cell))}</td>" for cell in row) for row in rows)
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return f"<p>{html.escape(str(title))}</p><table>{body}</table>"


FIELDS = {item.name: item.metadata for item in fields(Sample) if "dtype" in item.metadata}
"""Name of every field on disk, in order, to its `dtype`, `axes`, `unit`, `meaning`, `group`, and
whether it is `derived`."""
GROUPS = {
    group: tuple(name for name, about in FIELDS.items() if about["group"] == group)
    for group in dict.fromkeys(about["group"] for about in FIELDS.values())
}
"""The fields of every group; under "" those that every sample has."""
DERIVED = tuple(name for name, about in FIELDS.items() if about["derived"])
"""Fields that follow from others."""


@dataclass(frozen=True, kw_only=True)
class Schema:
    """Which fields the samples of a dataset have, and of which shapes."""

    grid: GridSpec
    lidar: Sensor
    groups: tuple[str, ...] = ()
    """The groups of fields that they have besides those of every sample."""
    scans: int = 1
    """Scans of a sample."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all fields, in order."""
        return tuple(name for name, about in FIELDS.items() if about["group"] in ("", *self.groups))

    def stored(self, *, compact: bool) -> tuple[str, ...]:
        """Names of the fields that a dataset stores: all, or, if `compact`, those that do not
        follow from others."""
        return tuple(name for name in self.names if not (compact and name in DERIVED))

    def shape(self, name: str) -> tuple[int, ...]:
        """The shape of a field of one sample."""
        named = {
            "grid": self.grid.shape,
            "rays": self.lidar.shape,
            "earlier": (self.scans - 1,),
        }
        axes = FIELDS[name]["axes"].split()
        return tuple(
            count for axis in axes for count in (named[axis] if axis in named else (int(axis),))
        )

    def describe(self) -> dict[str, dict[str, Any]]:
        """Every field: name to its numpy `dtype`, `shape`, `unit` ("" for none), and `meaning`."""
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
    """The fields of a sample that hold the scans before its own, the last made first; none where
    there is none."""
    if not scans:
        return {}
    values = zip(
        *((scan.ranges, scan.pose.position, scan.pose.quaternion) for scan in scans), strict=True
    )
    return {name: np.array(value) for name, value in zip(GROUPS["earlier"], values, strict=True)}


def _refuse_batch(batch: Any, *, collate_fn_map: Any = None) -> NoReturn:
    """What torch's default collate calls for a batch of samples."""
    raise TypeError(
        "torch's default collate cannot batch samples: give DataLoader `samples.torch()`, whose "
        "items are dictionaries of tensors, or a collate_fn of your own"
    )


def rng_of(seed: int, *key: int) -> np.random.Generator:
    """The random numbers that `seed` gives the part `key` of some work, whatever is drawn for
    others."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))


class Samples(Sequence[Sample]):
    """Samples by number: what a dataset's split and a stream have in common."""

    @property
    @abstractmethod
    def schema(self) -> Schema:
        """Which fields they have."""

    @property
    def schemas(self) -> Sequence[Schema]:
        """All schemas of samples among them: several where sources differ."""
        return [self.schema]

    @abstractmethod
    def __getitems__(self, indices: Sequence[int]) -> list[Sample]:
        """Several of them."""

    @overload
    def __getitem__(self, index: int) -> Sample: ...
    @overload
    def __getitem__(self, index: slice) -> list[Sample]: ...
    def __getitem__(self, index: int | slice) -> Sample | list[Sample]:
        if isinstance(index, slice):
            return self.__getitems__(range(*index.indices(len(self))))
        return self.__getitems__([index])[0]

    def _checked(self, index: Any) -> int:
        """The number of a sample, from 0 on. Raises TypeError and IndexError."""
        number = operator.index(index)
        if not -len(self) <= number < len(self):
            raise IndexError(f"{self}: has no sample {short(number)}")
        return number % len(self)

    def torch(self, fields: Sequence[str] | None = None) -> "TensorSamples":
        """The same samples as a map-style dataset of torch's, whose items are dictionaries of
        tensors: `DataLoader(samples.torch(), batch_size=8)` batches them.

        Args:
            fields: Names of the fields to read; all by default. Others are not read, nor derived.

        Returns:
            A `torch.utils.data.Dataset`. Shapes and types are those of `describe`, but for classes,
            which are int32.

        Raises:
            DatasetError: There is no such field, samples differ in its shape, or torch is not
                installed.
        """
        try:
            from scenegen.draw.tensors import tensors_of
        except ModuleNotFoundError as error:
            raise DatasetError(f"{self}: torch() {lacking(error) or error}") from None
        return tensors_of(self, fields)

    def describe(self) -> dict[str, dict[str, Any]]:
        """What a sample holds: name of each field to its `dtype`, `shape`, `unit` and `meaning`."""
        return self.schema.describe()

    def _repr_html_(self) -> str:
        """For notebooks: what they are, and what each holds."""
        rows = ((name, *about.values()) for name, about in self.describe().items())
        return html_table(rows, self)
