"""Sensors: where rays point, when each is cast, how far they reach. One file a family; each fills
`Sensor`.

Nothing else in the toolkit knows how a sensor works, so a new family is one new file, here or in a
user's folder."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from lidarsim.parameters import short_repr
from lidarsim.registry import Registry

if TYPE_CHECKING:  # the command line asks for the names, and must not load NumPy for that
    from lidarsim.grid import Floats


class Sensor(Protocol):
    """Rays that start together, from one point of a body. Attributes are read-only and constant.

    A sensor is a value: equal ones are equal by ``==``, and ``str`` describes it in a phrase."""

    @property
    def shape(self) -> tuple[int, ...]:
        """How the rays are ordered: (rows, columns), or (rays,), or any other way; a scan's ranges
        have this shape."""
        ...

    @property
    def directions_body(self) -> Floats:
        """Unit vectors (*shape, 3) in the body frame: x forward, y left, z up."""
        ...

    @property
    def times_s(self) -> Floats:
        """When each ray is cast, (*shape), seconds after the scan begins; zeros where all are cast
        at once."""
        ...

    @property
    def max_range_m(self) -> float:
        """Farthest return, metres; nothing is returned beyond."""
        ...


FAMILIES = {
    "raster": "lidarsim.sensors.raster:Lidar",
    "table": "lidarsim.sensors.table:BeamTable",
    "spinning": "lidarsim.sensors.spinning:Spinning",
    "rosette": "lidarsim.sensors.spinning:Rosette",
    "coil": "lidarsim.sensors.spinning:Coil",
    "pinhole": "lidarsim.sensors.raster:Pinhole",
}
"""Families: dataclasses whose fields are the parameters."""
TEXT = Path(__file__).with_name("catalogue.toml").read_text(encoding="utf-8")
"""The catalogue's text; its names are found without parsing it all."""
CATALOGUE = {
    name: name.partition("-")[2].replace("-", "_").upper()
    for name in re.findall(r"^\[(.+)\]$", TEXT, re.MULTILINE)
}
"""Sensors that people have: names, each with its object in `lidarsim.sensors.catalogue`."""

SENSORS = Registry(
    "sensor",
    FAMILIES | {name: f"lidarsim.sensors.catalogue:{place}" for name, place in CATALOGUE.items()},
    needs={
        "shape": "a tuple of counts, such as (16, 120)",
        "directions_body": "unit vectors (*shape, 3) in the body frame",
        "times_s": "seconds after the scan begins, (*shape)",
        "max_range_m": "metres",
    },
)
"""Sensors by name, for a recipe's ``[lidar] sensor = "…"``: families, and sensors of the catalogue,
whose fields a recipe changes."""
RASTER = "raster"
"""The sensor of a recipe that names none."""


def check_sensor(sensor: object) -> None:
    """Check that an object is a sensor, and not a name or a class.

    Args:
        sensor: The object.

    Raises:
        ValueError: If it is not a sensor.
    """
    if isinstance(sensor, type) or not hasattr(sensor, "max_range_m"):
        raise ValueError(
            f"sensor = {short_repr(sensor)}: expected an object, such as lidarsim.Lidar() or "
            f"lidarsim.sensors.catalogue.VLP_16"
        )
