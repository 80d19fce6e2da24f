"""A world while it is drawn: what a kind adds to, and the MJCF that comes of it."""

import functools
import math
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

FLIGHT_BOUNDS = "flight_bounds"
"""Name of the MJCF <numeric> that holds the box, least corner then greatest, in which the sensor may fly."""
COLOUR = (0.62, 0.64, 0.68, 1.0)
"""Colour, as red, green, blue and alpha, of solids that are given none."""
NUMBERS = {
    mujoco.mjtGeom.mjGEOM_SPHERE: ("", 1),
    mujoco.mjtGeom.mjGEOM_CAPSULE: (' type="capsule"', 2),
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: (' type="ellipsoid"', 3),
    mujoco.mjtGeom.mjGEOM_CYLINDER: (' type="cylinder"', 2),
    mujoco.mjtGeom.mjGEOM_BOX: (' type="box"', 3),
}
"""Shapes that are written here, with their attribute and how many sizes they have."""
MOST_WRITTEN = 4096
"""The most solids of a document without a <size memory> of its own, see `least_memory`."""
_PLACE = "    <light "
"""Where MuJoCo's writer puts the geoms: before this."""


class Drawing:
    """Solids under the world body, which MuJoCo's own writer, twenty times slower, would write to the same bytes.

    It can do all that a `mujoco.MjSpec` can: any attribute of one that is asked for makes one, with the solids so far
    in it, and from then on MuJoCo writes the document.
    """

    def __init__(self, flight_bounds: NDArray[np.float64]):
        self._bounds = tuple(np.asarray(flight_bounds, dtype=np.float64).reshape(-1).tolist())
        self._solids: list[dict[str, Any]] = []
        self._spec: mujoco.MjSpec | None = None

    def add_geom(self, shape: mujoco.mjtGeom, size: Any, position: Any, **more: Any) -> None:
        """Add one solid, lengths in metres. `more` may give `quat` (w x y z) and `rgba`, and all else that MuJoCo's
        `add_geom` takes."""
        solid = {"type": shape, "size": size, "pos": position, **more}
        if self._spec is None:
            self._solids.append(solid)
        else:
            self._spec.worldbody.add_geom(**solid)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        if self._spec is None:
            self._spec = _empty(self._bounds)
            for solid in self._solids:
                self._spec.worldbody.add_geom(**solid)
        return getattr(self._spec, name)

    def mjcf(self) -> bytes:
        """The document, UTF-8. Raises ValueError for what MuJoCo does not take."""
        if self._spec is None and len(self._solids) <= MOST_WRITTEN:
            lines = [_line(**solid) for solid in self._solids]
            if None not in lines:
                before, after = _around(self._bounds)
                return (before + "".join(map(str, lines)) + after).encode()
        self.worldbody  # noqa: B018 (from here on, there is a spec)
        assert self._spec is not None
        self._spec.memory = least_memory(len(self._spec.geoms))
        return self._spec.to_xml().encode()


def least_memory(geoms: int) -> int:
    """Bytes for MuJoCo's <size memory>: as little as will do, for they are taken anew for every world."""
    return max(1 << 20, 256 * geoms)


def _empty(bounds: tuple[float, ...]) -> mujoco.MjSpec:
    """A world with nothing but light."""
    spec = mujoco.MjSpec()
    spec.modelname = "scenegen"
    spec.default.geom.rgba = COLOUR
    spec.add_numeric(name=FLIGHT_BOUNDS, data=bounds, size=6)
    spec.worldbody.add_light(pos=[0, 0, 30], dir=[0.2, 0.1, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    return spec


@functools.lru_cache(maxsize=8)
def _around(bounds: tuple[float, ...]) -> tuple[str, str]:
    """What MuJoCo writes before and after the geoms of a world."""
    spec = _empty(bounds)
    spec.memory = least_memory(0)
    before, light, after = spec.to_xml().partition(_PLACE)
    return before, light + after


def _line(
    type: mujoco.mjtGeom, size: Any, pos: Any, quat: Any = (1.0, 0.0, 0.0, 0.0), rgba: Any = COLOUR, **more: Any
) -> str | None:
    """A geom as MuJoCo writes it; None for one that is left to MuJoCo."""
    attribute, count = NUMBERS.get(type, ("", 0))
    w, x, y, z = map(float, quat)
    length = math.sqrt(w * w + x * x + y * y + z * z)
    sizes, place = [float(value) for value in size][:count], [float(value) for value in pos]
    numbers = (*sizes, *place, w, x, y, z)
    if not count or more or not all(map(_plain, numbers)) or not 0.5 < length < 2.0:
        return None
    turn = (w / length, x / length, y / length, z / length)
    line = f'    <geom size="{_text(sizes)}"'
    if any(place):
        line += f' pos="{_text(place)}"'
    if turn != (1.0, 0.0, 0.0, 0.0):
        line += f' quat="{_text(turn)}"'
    line += attribute
    if tuple(rgba) != COLOUR:
        line += f' rgba="{_text(rgba)}"'
    return line + "/>\n"


def _plain(value: float) -> bool:
    """Whether MuJoCo writes a number as it does most: no zero of its own rounding, and no large whole number."""
    return value == 0.0 or 1e-9 <= abs(value) < 1e5


def _text(values: Sequence[float]) -> str:
    """Numbers with six digits, as C++ writes them."""
    return " ".join([f"{value + 0.0:.6g}" for value in values])
