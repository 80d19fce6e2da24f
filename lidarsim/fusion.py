"""How several scans become one map: the parameters of `lidarsim.fuse`, which commands read
without numpy."""

from dataclasses import dataclass
from typing import Literal

from lidarsim.parameters import check, number


@dataclass(frozen=True, kw_only=True)
class Fusion:
    """A rule by which scans are fused.

    The log-odds are OctoMap's, with its defaults (Hornung et al. 2013, Autonomous Robots 34,
    189–206); they say nothing where `fusion` is "visibility".
    """

    fusion: Literal["visibility", "log-odds"] = "visibility"
    """How scans make one map. "visibility": a voxel with any return is observed."""
    hit: float = number(0.7, above=0.5, below=1)
    """With log-odds: probability of a voxel in which a scan has a return."""
    miss: float = number(0.4, above=0, below=0.5)
    """With log-odds: probability of a voxel that rays of a scan cross without a return."""
    least: float = number(0.1192, above=0, below=0.5)
    """With log-odds: minimum probability."""
    most: float = number(0.971, above=0.5, below=1)
    """With log-odds: maximum probability; log-odds of -2 and 3.5 are the bounds of the paper."""
    occupied: float = number(0.5, minimum=0.5, below=1)
    """With log-odds: minimum probability of an observed voxel."""

    def __post_init__(self) -> None:
        check(self)
        if self.occupied > self.most:
            raise ValueError(f"occupied = {self.occupied}: expected at most `most`, {self.most}")
