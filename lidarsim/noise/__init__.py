"""Sensor noise: stages that turn clean ranges into a real sensor's, drawn from an explicit `rng`.

    chain = Noise.parse("divergence:3,range:0.02,dropout:0.05")
    seen = chain.observe(scan, engine, rng=np.random.default_rng(0))

`ranges` has errors of the range itself, and beams that are cones; `losses` has missing and spurious
returns, and motion; `returns` has intensity, random numbers, and the data that stages pass on.
`chain` reads and applies stages."""

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
    """Its place in a chain: 0 if it changes where rays begin and go, 1 if it casts more rays around
    them, 2 if it changes returns. A chain has at most one stage of 0 and one of 1."""

    def apply(self, returns: Returns, view: View, *, rng: np.random.Generator) -> Returns:
        """Apply the fault to returns.

        Args:
            returns: The returns so far.
            view: The sensor in its world, for stages that cast rays or need surfaces.
            rng: The stage's own stream.

        Returns:
            The returns after the fault.
        """
        ...

    def bound_m(self, max_range_m: float) -> float:
        """Return how far it moves a return at most, metres, of a sensor of that range; inf for no
        bound."""
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
