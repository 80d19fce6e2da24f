"""A sensor as a table of its rays, and what sensors that are sold have in common."""

import dataclasses
import hashlib
import io
import math
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarsim.grid import Floats
from lidarsim.parameters import (
    FILE,
    LEAST_RANGE_M,
    MOST_RANGE_M,
    MOST_RAYS,
    MOST_TEXT,
    check,
    check_text,
    number,
    shown,
)
from lidarsim.sensors import Sensor, check_sensor

MOST_AXES = 4
"""The most axes of a sensor's shape."""
MOST_HEADER_BYTES = 4096
"""The most bytes of an .npy file's header: more than any of ours takes."""
UNIT = 1e-9
"""How far from 1 the length of a direction may be."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BeamTable:
    """Rays listed one by one: a `Sensor`, which a recipe names by ``[lidar] sensor = "table"``. Two
    are equal where all of their numbers are.

    Raises ValueError for rays that have no direction, or times and a range that no scan has, and
    for a file that is not there, or not the one meant.
    """

    rays: Floats = field(metadata={FILE: True})
    """(*shape, 4): x, y, z of each ray's unit vector in the body frame, and when it is cast,
    seconds after the scan begins; given as float64, or as the path of an .npy file of them."""
    max_range_m: float = number(10.0, least=LEAST_RANGE_M, most=MOST_RANGE_M)
    """Farthest return, metres."""
    made_by: str = ""
    """What the table was made by, for people to read."""
    sha256: str = ""
    """The SHA-256 of `npy`, in hexadecimal; given, what the file of the rays must have."""

    def __post_init__(self) -> None:
        given: Any = self.rays
        if isinstance(given, str | Path):
            given = _read_file(Path(given), self.sha256)
        rays = np.array(given, float)
        shape = rays.shape[:-1]
        if (
            rays.shape[-1:] != (4,)
            or not 1 <= len(shape) <= MOST_AXES
            or not 0 < math.prod(shape) <= MOST_RAYS
        ):
            raise ValueError(
                f"rays of shape {rays.shape}: expected (*shape, 4), from 1 to {MOST_RAYS} rays"
            )
        lengths = np.sqrt((rays[..., :3] ** 2).sum(axis=-1))
        if len(odd := lengths[~(np.abs(lengths - 1.0) <= UNIT)]):
            raise ValueError(
                f"a ray's direction has length {odd[0]:.9g}, expected 1 to {UNIT:g}; divide it by "
                "its length in float64"
            )
        if not ((rays[..., 3] >= 0) & np.isfinite(rays[..., 3])).all():
            raise ValueError(
                "a ray's time is negative or no number; expected seconds after the scan begins"
            )
        check(self)
        check_text("made_by", self.made_by)
        rays.setflags(write=False)
        object.__setattr__(self, "rays", rays)
        object.__setattr__(self, "sha256", hashlib.sha256(self.npy).hexdigest())

    @classmethod
    def of(cls, sensor: Sensor) -> "BeamTable":
        """The table of any sensor's rays, with the same bits. Raises ValueError where the sensor is
        none."""
        check_sensor(sensor)
        shape = tuple(int(count) for count in sensor.shape)
        directions = _numbers(sensor.directions_body, "directions_body", (*shape, 3))
        times = _numbers(sensor.times_s, "times_s", shape)
        rays = np.concatenate([directions, times[..., None]], axis=-1)
        return cls(
            rays=rays,
            max_range_m=sensor.max_range_m,
            made_by=getattr(sensor, "made_by", _maker(sensor)),
        )

    @property
    def shape(self) -> tuple[int, ...]:
        """How the rays are ordered."""
        return self.rays.shape[:-1]

    @cached_property
    def directions_body(self) -> Floats:
        """Unit vectors (*shape, 3) in the body frame."""
        directions = np.ascontiguousarray(self.rays[..., :3])
        directions.setflags(write=False)
        return directions

    @property
    def times_s(self) -> Floats:
        """(*shape), seconds after the scan begins."""
        return self.rays[..., 3]

    @cached_property
    def npy(self) -> bytes:
        """`rays` as an .npy file: little-endian, C order, format 1.0."""
        file = io.BytesIO()
        np.lib.format.write_array(
            file, self.rays.astype("<f8", order="C"), version=(1, 0), allow_pickle=False
        )
        return file.getvalue()

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, BeamTable):
            return NotImplemented
        return self.max_range_m == other.max_range_m and np.array_equal(self.rays, other.rays)

    def __hash__(self) -> int:
        return hash((self.shape, self.max_range_m))

    def __str__(self) -> str:
        made = f" of {self.made_by}" if self.made_by else ""
        return f"{' × '.join(map(str, self.shape))} rays{made}, up to {self.max_range_m:g} m"

    def __getstate__(self) -> dict[str, Any]:
        return {item.name: getattr(self, item.name) for item in dataclasses.fields(self)}


def _read_file(path: Path, sha256: str) -> NDArray[Any]:
    """The array in an .npy file, whose SHA-256 is that, where one is given."""
    if not path.is_file():  # and no pipe, whose reading might never end
        raise ValueError(f"rays = {path.name!a}: there is no such file in {str(path.parent)!a}")
    with open(path, "rb") as file:
        content = file.read(most_bytes(MOST_RAYS) + 1)
    if sha256 and hashlib.sha256(content).hexdigest() != sha256:
        raise ValueError(f"rays = {path.name!a}: is not the file whose sha256 is {shown(sha256)}")
    return read_npy(content)


def most_bytes(rays: int) -> int:
    """What an .npy file of so many rays may take."""
    return 32 * rays + MOST_HEADER_BYTES


def read_npy(content: bytes) -> NDArray[Any]:
    """The array in an .npy file. Raises ValueError where it holds none, or one of objects."""
    try:
        return np.asarray(
            np.lib.format.read_array(
                io.BytesIO(content), allow_pickle=False, max_header_size=MOST_HEADER_BYTES
            )
        )
    except Exception as error:  # NumPy's, and what else a crafted file brings
        raise ValueError(f"no .npy file of numbers ({str(error).splitlines()[0][:100]})") from None


def _maker(sensor: Sensor) -> str:
    """A sensor's class and parameters: ``my_sensor:Rosette(petals=7)``; files by their names
    alone."""
    values: dict[str, Any] = {}
    if dataclasses.is_dataclass(sensor):
        values = {item.name: getattr(sensor, item.name) for item in dataclasses.fields(sensor)}
    given = ", ".join(
        f"{name}={value.name if isinstance(value, Path) else repr(value)}"
        for name, value in values.items()
    )
    said = f"{type(sensor).__module__}:{type(sensor).__name__}({given})"
    return "".join(one if one.isprintable() else "?" for one in said)[:MOST_TEXT]


def _numbers(values: ArrayLike, what: str, shape: tuple[int, ...]) -> Floats:
    try:
        numbers = np.asarray(values, float)
    except (TypeError, ValueError):
        raise ValueError(f"{what} is no array of numbers") from None
    if numbers.shape != shape:
        raise ValueError(f"{what} has shape {numbers.shape}, expected {shape}, as `shape` says")
    return numbers
