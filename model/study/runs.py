"""How large a study is, and which networks it trains."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from lidarsim.parameters import Checked, number
from scenegen.errors import DatasetError, printable
from scenegen.limits import MOST_MAPS, MOST_SEED

KINDS = ("geometric", "pillar")
"""The kinds of worlds that every network is trained on."""
TRIALS = 2000
"""Planning trials a kind at scale 1 (the paper's)."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """One training run. Runs of a study differ in what stands here, and in nothing else."""

    name: str
    """What its folder and its row are called: the method, and the seed as in ``occ-s0``."""
    asks: str
    """What it is for."""
    seed: int
    settings: Mapping[str, Any] = field(default_factory=dict)
    """What it has in place of other settings of `scenegen.train`."""


METHODS: tuple[tuple[str, int, str, dict[str, Any]], ...] = (
    ("occ", 3, "the paper's OCC-only", {"variant": "occ"}),
    ("proposed", 3, "the paper's network, λ_occ 0.1", {}),
    ("proposed-1", 3, "λ_occ 1: distances leave occupancy its share", {"occupancy": 1.0}),
    ("tudf", 2, "the paper's TUDF-only", {"variant": "tudf"}),
    ("no-eikonal", 2, "the paper's without the Eikonal term", {"eikonal": 0.0}),
    (
        "columns",
        2,
        "columns seen whole, free space",
        {"variant": "columns", "inputs": ("observed", "free"), "occupancy": 1.0},
    ),
)
"""Every method: its name, its number of training seeds, what it is for, and its settings. No
ordering is claimed from one seed."""
RUNS = tuple(
    Run(name=f"{name}-s{seed}", asks=asks, seed=seed, settings=settings)
    for seed in range(max(count for _, count, _, _ in METHODS))
    for name, count, asks, settings in METHODS
    if seed < count
)


@dataclass(frozen=True, kw_only=True)
class ReproduceConfig(Checked):
    """The size of a study. At scale 1 it is the paper's in samples and trials."""

    scale: float = number(1.0, above=0, most=1)
    """Share of all samples, maps and trials."""
    maps: int = number(20_000, least=1, most=MOST_MAPS)
    """Maps that every network sees, at scale 1."""
    seed: int = number(0, least=0, most=MOST_SEED)
    """Seed of the datasets, the goals and the intervals."""

    def scaled(self, count: int) -> int:
        """`count` at this scale, at least 1."""
        return max(round(count * self.scale), 1)

    @property
    def counts(self) -> dict[str, int]:
        """Samples of every kind, by split."""
        return {"train": self.scaled(2500), "val": self.scaled(250), "test": self.scaled(500)}


def chosen(only: tuple[str, ...]) -> tuple[Run, ...]:
    """The runs that are called one of `only`; all of them for none. Raises DatasetError for a name
    that is no run's."""
    known = {run.name: run for run in RUNS}
    if odd := [name for name in only if name not in known]:
        raise DatasetError(f"--only {printable(odd[0])}: no such run; known are {', '.join(known)}")
    return tuple(known[name] for name in only) or RUNS
