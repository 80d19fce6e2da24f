"""What a real sensor adds to clean ranges: stages that compose, drawn from an explicit `rng`.

    chain = Noise.parse("divergence:3,range:0.02,dropout:0.05")
    seen = chain.observe(scan, engine, rng=np.random.default_rng(0))

`ranges` has the faults of a range itself, and beams that are cones; `losses` has returns that go
missing or are of nothing, and motion; `returns` has intensity, and what stages pass on. `chance`
draws normal numbers. `chain` reads and applies them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from lidarsim.registry import Registry

if TYPE_CHECKING:  # the command line asks for the names, and must not load NumPy for that
    import numpy as np

    from lidarsim.noise.returns import Returns, View


VERSION = 2
"""Raised whenever the same stages and the same `rng` would give other bits. 1 drew normal numbers
by logarithms and sines."""


class Stage(Protocol):
    """One fault: a frozen dataclass, whose fields are its parameters. The same `rng` gives the same
    bits."""

    order: int
    """When its turn is: 0 for where rays begin and go, 1 for what else is cast around them, 2 for
    what becomes of the returns. A chain has one stage of 0 and one of 1 at most."""

    def apply(self, returns: Returns, view: View, *, rng: np.random.Generator) -> Returns:
        """What is left of `returns`, and where."""
        ...

    def bound_m(self, max_range_m: float) -> float:
        """How far at most it moves a return of a sensor of that range, metres; inf where nothing
        bounds it."""
        ...


STAGES = Registry(
    "noise stage",
    {
        "motion": "lidarsim.noise.losses:Motion",
        "divergence": "lidarsim.noise.ranges:Divergence",
        "near": "lidarsim.noise.ranges:Near",
        "range": "lidarsim.noise.ranges:Range",
        "depth": "lidarsim.noise.ranges:Depth",
        "quantise": "lidarsim.noise.ranges:Quantise",
        "dropout": "lidarsim.noise.losses:Dropout",
        "far": "lidarsim.noise.losses:Far",
        "grazing": "lidarsim.noise.losses:Grazing",
        "faint": "lidarsim.noise.losses:Faint",
        "spurious": "lidarsim.noise.losses:Spurious",
        "intensity": "lidarsim.noise.returns:Intensity",
    },
    needs={
        "order": "0 where it says how rays are cast, 1 where it casts more, 2 where it changes "
        "returns",
        "apply": "a method: (returns, view, *, rng) -> returns",
        "bound_m": "a method: (max_range_m) -> metres that a return moves at most",
    },
)
"""Stages by name."""
