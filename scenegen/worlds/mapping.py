"""Mapping by a robot: which scans of a flight make a map, how the sensor is held, where the map
lies."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from lidarsim.fusion import Fusion
from lidarsim.parameters import MAX_LENGTH_M, Checked, number
from scenegen.base.limits import MAX_DRAWN_M, MAX_SCANS, MIN_DRAWN_M

if TYPE_CHECKING:  # commands take their options from here, and none of these
    from lidarsim import GridSpec, Pose, Sensor


@dataclass(frozen=True, kw_only=True)
class Known(Checked):
    """A recipe's [known]: how much of a map of a real place must be known where a sensor scans."""

    most_unknown_m: float = number(0.6, minimum=0, maximum=MAX_LENGTH_M)
    """Maximum unknown space that a ray of `ray_known` crosses, metres."""
    most_marked_share: float = number(0.35, minimum=0, maximum=1)
    """Maximum share of a viewpoint's rays that cross more unknown space."""
    least_share: float = number(0.05, minimum=0, maximum=1)
    """Minimum share of known voxels of a viewpoint's map."""


@dataclass(frozen=True, kw_only=True)
class Mapper(Fusion):
    """A recipe's [mapping]. By default, a map is what one scan shows around a level sensor."""

    scans: int = number(1, minimum=1, maximum=MAX_SCANS)
    """Scans that make a map: the sample's own, and those before it on the flight."""
    scan_spacing_m: float = number(0.5, minimum=MIN_DRAWN_M, maximum=MAX_LENGTH_M)
    """Distance from scan to scan along the flight."""
    tilt_mps: float = number(0.0, minimum=0, maximum=100)
    """Speed of a flight that tilts the body, metres a second; 0: a level body."""
    settle_s: float = number(0.5, minimum=0.01, maximum=100)
    """With tilt: seconds before and after a corner over which the velocity changes."""
    most_tilt_deg: float = number(30.0, above=0, maximum=80)
    """Maximum tilt of the body, degrees."""
    map_ahead_m: tuple[float, float, float] = number(
        (0.0, 0.0, 0.0), minimum=-MAX_DRAWN_M, maximum=MAX_DRAWN_M
    )
    """Centre of the map from the sensor: forward along its heading, to its left, and up, metres."""

    @property
    def plain(self) -> bool:
        """Whether samples are those of a recipe without [mapping]."""
        return (
            self.scans == 1 and self.fusion == "visibility" and not self.tilt_mps and self.centred
        )

    def __str__(self) -> str:
        """Describe it: "of 5 scans, 0.5 m apart, by visibility, around a level sensor"."""
        scans, held, place = "1 scan", "a level sensor", "around"
        if self.scans > 1:
            scans = f"{self.scans} scans, {self.scan_spacing_m:g} m apart"
        if self.tilt_mps:
            held = f"a sensor that leans at {self.tilt_mps:g} m/s"
        if not self.centred:
            place = f"{', '.join(f'{part:g}' for part in self.map_ahead_m)} m ahead of"
        return f"of {scans}, by {self.fusion}, {place} {held}"

    @property
    def centred(self) -> bool:
        """Whether the sensor is in the map's middle."""
        return not any(self.map_ahead_m)

    def origin(self, grid: "GridSpec", pose: "Pose") -> Any:
        """Compute the least corner of a map.

        Args:
            grid: The map's grid.
            pose: The sensor's pose.

        Returns:
            (3,), metres, in the world.

        Raises:
            ValueError: If the sensor is upside down, so that its heading is undefined.
        """
        if self.centred:
            return grid.origin_at(pose.position)
        w, _, _, z = pose.quaternion.tolist()
        # the heading is the yaw of the quaternion's part about the vertical
        length = w * w + z * z
        if not length > 0.0:
            raise ValueError(
                "the sensor lies on its head, and has no heading by which its map could lie ahead"
            )
        cosine, sine = (w * w - z * z) / length, 2 * w * z / length
        forward, left, up = self.map_ahead_m
        x, y, above = pose.position.tolist()
        return grid.origin_at(
            [x + (cosine * forward - sine * left), y + (sine * forward + cosine * left), above + up]
        )

    def check_reach(self, grid: "GridSpec", max_range_m: float, rays: int, max_rays: int) -> None:
        """Check that rays reach the map, and that a sample's scans are not too large.

        Args:
            grid: The map's grid.
            max_range_m: The sensor's range, metres.
            rays: Rays of one scan.
            max_rays: The limit for all scans of a sample.

        Raises:
            ValueError: If no ray reaches the map, or the scans exceed the limit.
        """
        for ahead, extent in zip(self.map_ahead_m, grid.extent_m, strict=True):
            # the map's nearest face along this axis
            if not abs(ahead) - extent / 2 < max_range_m:
                raise ValueError(
                    f"[mapping] map_ahead_m = {list(self.map_ahead_m)}: lies beyond the sensor's "
                    f"range of {max_range_m:g} m; expected a map that rays reach"
                )
        if self.scans * rays > max_rays:
            raise ValueError(
                f"[mapping] scans = {self.scans}: of {rays} rays each; expected "
                f"{math.floor(max_rays / rays)} at most"
            )


class Sensing(NamedTuple):
    """How samples were sensed."""

    lidar: "Sensor"
    mapping: Mapper
    noise: str
    """Its stages, as a manifest spells them; "" for none."""
