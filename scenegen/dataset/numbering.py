"""How a split's samples are numbered: which world and which of its viewpoints the sample at a place
is of."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Numbering:
    """The rule of docs/format.md, for one split. A place may be one number, or an array of them."""

    viewpoints: int
    """Samples of one flight."""
    scenes: int | None
    """Worlds from MJCF files, which flights visit in turn; None where each flight has a world of
    its own."""

    def name(self, place: Any) -> tuple[Any, Any]:
        """(world, viewpoint) of the sample at `place`."""
        unit, view = place // self.viewpoints, place % self.viewpoints
        if self.scenes is None:
            return unit, view
        return unit % self.scenes, unit // self.scenes * self.viewpoints + view

    def place(self, world: Any, viewpoint: Any) -> Any:
        """The place of the sample that is `viewpoint` of `world`."""
        if self.scenes is None:
            return world * self.viewpoints + viewpoint
        turn, view = viewpoint // self.viewpoints, viewpoint % self.viewpoints
        return (turn * self.scenes + world) * self.viewpoints + view

    def worlds(self, start: int, samples: int) -> Sequence[int]:
        """Numbers of the worlds that so many samples are of, from the one at `start` on, rising."""
        units = range(start // self.viewpoints, (start + samples - 1) // self.viewpoints + 1)
        return (
            units
            if self.scenes is None
            else sorted({unit % self.scenes for unit in units[: self.scenes]})
        )
