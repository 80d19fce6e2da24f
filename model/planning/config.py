"""The planner's parameters and the trials'."""

from dataclasses import dataclass
from typing import Literal

import numpy as np


@dataclass(frozen=True, kw_only=True)
class PlanConfig:
    """How paths are searched, refined and judged.

    "Paper" is the paper's section "Implementation Details" or "Planning Evaluation"; "ours" is what it leaves open.
    """

    step_voxels: int = 3
    """Lattice step of A*, voxels: 0.6 m at 0.2 m a voxel (paper)."""
    edge_check: bool = False
    """Whether A* also asks that the voxels between two nodes be free, or the nodes' own alone (ours)."""
    safety_m: float = 1.0
    """d_s, the clearance below which waypoints are pushed away, metres (the paper names it without a value; ours)."""
    clearance_weight: float = 1.0
    """lambda_c, of the squared clearance deficit against the squared second differences, both in m^2 (paper)."""
    iterations: int = 50
    """Steps of gradient descent (paper)."""
    first_step: float = 1.0
    """Length of the first step tried, in gradients; later ones begin at the last accepted one, lengthened (ours)."""
    shrink: float = 0.5
    """Factor by which a step that is not accepted is shortened, and by whose inverse the next is lengthened (ours)."""
    armijo: float = 0.1
    """Share of the decrease promised by the gradient that a step must bring; small ones let steps overshoot (ours)."""
    sample_m: float = 0.05
    """Longest gap between the points at which a path is judged, metres (ours)."""
    clearance: Literal["trilinear", "voxel"] = "trilinear"
    """How the truth's TUDF is read at those points: between voxel centres, or the value of the point's voxel (ours:
    the first, as the refinement reads its own)."""
    goal_faces: Literal["lateral", "box"] = "box"
    """Where goals lie: in the outermost layer of nodes in x or y, or in z, too (ours: "near the map boundary")."""

    def __post_init__(self) -> None:
        for name, least in (("step_voxels", 1), ("iterations", 0)):
            value = getattr(self, name)
            if int(value) != value or value < least:
                raise ValueError(f"plan: {name} = {value} must be a whole number of at least {least}")
        for name in ("safety_m", "clearance_weight"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ValueError(f"plan: {name} = {value} must be finite and at least 0")
        for name in ("first_step", "sample_m"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"plan: {name} = {value} must be finite and above 0")
        for name in ("shrink", "armijo"):
            value = getattr(self, name)
            if not 0 < value < 1:
                raise ValueError(f"plan: {name} = {value} must lie between 0 and 1")
        for name, known in (("clearance", ("trilinear", "voxel")), ("goal_faces", ("lateral", "box"))):
            value = getattr(self, name)
            if value not in known:
                raise ValueError(f"plan: {name} = {value!r} must be one of {', '.join(known)}")
