"""A sensor as a table of its rays."""

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
    MAX_RANGE_M,
    MAX_RAYS,
    MAX_TEXT,
    MIN_RANGE_M,
    check,
    check_text,
    number,
    short_repr,
)
from lidarsim.sensors import Sensor, check_sensor

MAX_AXES = 4
"""The most axes of a sensor's shape."""
MAX_NPY_HEADER_BYTES = 4096
"""The most bytes of an .npy file's header: more than any of ours takes."""
UNIT = 1e-9
"""Tolerance of a direction's length."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BeamTable:
    """Rays listed one by one: a `Sensor`, named in a recipe by ``[lidar] sensor = "table"``. Tables
    with equal numbers are equal.

    Raises ValueError if a ray has no direction, a time or the range is invalid, or the file is
    missing or has another checksum."""

    rays: Floats = field(metadata={FILE: True})
    """(*shape, 4): x, y, z of each ray's unit vector in the body frame, and when it is cast,
    seconds after the scan begins; given as float64, or as the path of an .npy file of them."""
    max_range_m: float = number(10.0, minimum=MIN_RANGE_M, maximum=MAX_RANGE_M)
    """Farthest return, metres."""
    made_by: str = ""
    """The sensor or program that made the table, for people."""
    sha256: str = ""
    """The SHA-256 of `npy`, in hexadecimal; a given one must be that of the rays' file."""

    def __post_init__(self) -> None:
        source: Any = self.rays
        if isinstance(source, str | Path):
            source = _read_file(Path(source), self.sha256)
        rays = np.array(source, float)
        shape = rays.shape[:-1]
        if (
            rays.shape[-1:] != (4,)
            or not 1 <= len(shape) <= MAX_AXES
            or not 0 < math.prod(shape) <= MAX_RAYS
        ):
            raise ValueError(
                f"rays of shape {rays.shape}: expected (*shape, 4), from 1 to {MAX_RAYS} rays"
            )
        lengths = np.sqrt((rays[..., :3] ** 2).sum(axis=-1))
        if len(bad := lengths[~(np.abs(lengths - 1.0) <= UNIT)]):
            raise ValueError(
                f"a ray's direction has length {bad[0]:.9g}, expected 1 to {UNIT:g}; divide it by "
                "its length in float64"
            )
        # False for NaN, too
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
        """Tabulate any sensor's rays, with the same bits. Raises ValueError if it is not a
        sensor."""
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
        maker = f" of {self.made_by}" if self.made_by else ""
        return f"{' × '.join(map(str, self.shape))} rays{maker}, up to {self.max_range_m:g} m"

    def __getstate__(self) -> dict[str, Any]:
        return {item.name: getattr(self, item.name) for item in dataclasses.fields(self)}


def _read_file(path: Path, sha256: str) -> NDArray[Any]:
    """Read an .npy file, and check its SHA-256 unless that is ""."""
    if not path.is_file():  # a pipe is no file: reading it might never end
        raise ValueError(f"rays = {path.name!a}: there is no such file in {str(path.parent)!a}")
    with open(path, "rb") as file:
        # one byte more than the limit shows that a file is too long, without reading it all
        content = file.read(max_bytes(MAX_RAYS) + 1)
    if sha256 and hashlib.sha256(content).hexdigest() != sha256:
        raise ValueError(
            f"rays = {path.name!a}: is not the file whose sha256 is {short_repr(sha256)}"
        )
    return read_npy(content)


def max_bytes(rays: int) -> int:
    """Return the greatest size of an .npy file of so many rays."""
    return 32 * rays + MAX_NPY_HEADER_BYTES


def read_npy(content: bytes) -> NDArray[Any]:
    """Read an .npy file of numbers.

    Args:
        content: The file's bytes.

    Returns:
        The array.

    Raises:
        ValueError: If they are not an .npy file, or one of Python objects.
    """
    try:
        return np.asarray(
            np.lib.format.read_array(
                io.BytesIO(content), allow_pickle=False, max_header_size=MAX_NPY_HEADER_BYTES
            )
        )
    except Exception as error:  # NumPy's, and what else a crafted file brings
        raise ValueError(f"no .npy file of numbers ({str(error).splitlines()[0][:100]})") from None


def _maker(sensor: Sensor) -> str:
    """Describe a sensor's class and parameters: ``my_sensor:Rosette(petals=7)``; of files only the
    names."""
    values: dict[str, Any] = {}
    if dataclasses.is_dataclass(sensor):
        values = {item.name: getattr(sensor, item.name) for item in dataclasses.fields(sensor)}
    arguments = ", ".join(
        f"{name}={value.name if isinstance(value, Path) else repr(value)}"
        for name, value in values.items()
    )
    description = f"{type(sensor).__module__}:{type(sensor).__name__}({arguments})"
    return "".join(letter if letter.isprintable() else "?" for letter in description)[:MAX_TEXT]


def _numbers(values: ArrayLike, name: str, shape: tuple[int, ...]) -> Floats:
    try:
        numbers = np.asarray(values, float)
    except (TypeError, ValueError):
        raise ValueError(f"{name} is no array of numbers") from None
    if numbers.shape != shape:
        raise ValueError(f"{name} has shape {numbers.shape}, expected {shape}, as `shape` says")
    return numbers
