"""What the bench measures, and how. Nothing heavy is imported here: the command line reads its
options here."""

from dataclasses import dataclass, field
from typing import Literal

from lidarsim.parameters import Checked, number
from scenegen.model.config import Thresholds

NEAR_M = 1.0
"""The paper's bound of what is near an obstacle, metres."""


@dataclass(frozen=True, kw_only=True)
class PlanConfig(Checked):
    """How paths are searched, refined and judged.

    "Paper" is the paper's section "Implementation Details" or "Planning Evaluation"; "ours" is what
    it leaves open.
    """

    planner: Literal["paper", "careful"] = "paper"
    """`paper`: the shortest path through free nodes, refined. `careful`: edges must be free, too,
    and the start's own voxel is, since a hovering robot is there; ways are weighed by their risk;
    where the refined path is riskier than that of A*, A*'s stands (ours)."""
    step_voxels: int = number(3, least=1)
    """Lattice step of A*, voxels: 0.6 m at 0.2 m a voxel (paper)."""
    edge_check: bool = False
    """Whether A* also asks that the voxels between two nodes be free, or the nodes' own alone
    (ours)."""
    careful_probability: float = number(0.95, above=0, below=1)
    """The careful planner holds a voxel occupied whose probability is greater than this (ours)."""
    unseen_risk: float = number(0.2, least=0, below=1)
    """The least risk of a voxel that no ray has crossed, to the careful planner, whatever its
    probability (ours)."""
    risk_weight: float = number(10.0, least=0)
    """How many metres of detour the careful planner prefers to one metre through a probability of 1
    (ours)."""
    safety_m: float = number(1.0, least=0)
    """d_s, the clearance below which waypoints are pushed away, metres (the paper names it without
    a value; ours)."""
    clearance_weight: float = number(1.0, least=0)
    """lambda_c, of the squared clearance deficit against the squared second differences, both in
    m^2 (paper)."""
    field: Literal["predicted", "transform"] = "predicted"
    """What the refinement reads: the distances of the prediction, where it has some, or the
    transform of its occupancy (ours)."""
    iterations: int = number(50, least=0)
    """Steps of gradient descent (paper)."""
    goal_faces: Literal["lateral", "box"] = "box"
    """Where goals lie: in the outermost layer of nodes in x or y, or in z, too (ours: "near the map
    boundary")."""


@dataclass(frozen=True, kw_only=True)
class BenchConfig(Checked):
    """What is measured, and how much of it."""

    split: Literal["train", "val", "test"] = "test"
    """The split that is measured; calibration looks at val."""
    samples: int | None = None
    """At most this many of the split's samples, evenly spread; None for all."""
    trials: int = number(2000, least=1)
    """Valid planning trials a dataset, spread over its samples (the paper's number)."""
    seed: int = number(0, least=0)
    """Seed of goals and permutations."""
    study: bool = False
    """Whether the report has a study beside its tables, of probabilities, bounds and risks."""
    thresholds: Thresholds = field(default_factory=Thresholds)
    plan: PlanConfig = field(default_factory=PlanConfig)
