"""What a study trains: every run by name."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from lidarsim.parameters import check, number
from scenegen.limits import MOST_MAPS, MOST_SEED
from scenegen.model.config import LossConfig, NetworkConfig, Thresholds, TrainConfig

KINDS = ("geometric", "pillar")
"""The kinds of worlds that every network is trained on."""
SEEDS = {"occ": 3, "proposed": 3, "proposed-1": 3}
"""How many seeds the runs have that a verdict compares, where it is not `LEAST_SEEDS`: no ordering
is claimed from one."""
LEAST_SEEDS = 2


@dataclass(frozen=True, kw_only=True)
class ReproduceConfig:
    """The size of a study. At scale 1 it is the paper's in samples and trials."""

    scale: float = number(1.0, above=0, most=1)
    """Share of all samples, maps and trials."""
    maps: int = number(20_000, least=1, most=MOST_MAPS)
    """Maps that every network sees, at scale 1."""
    seed: int = number(0, least=0, most=MOST_SEED)
    """Seed of the datasets, the goals and the intervals."""
    only: tuple[str, ...] = ()
    """Names of runs; all of them where none is named."""

    def __post_init__(self) -> None:
        check(self)

    def scaled(self, count: int) -> int:
        """`count` at this scale, at least 1."""
        return max(round(count * self.scale), 1)

    @property
    def counts(self) -> dict[str, int]:
        """Samples of every kind, by split."""
        return {"train": self.scaled(2500), "val": self.scaled(250), "test": self.scaled(500)}


@dataclass(frozen=True, kw_only=True)
class Worlds:
    """Worlds, or ground truth, other than the presets'."""

    asks: str
    """What is unlike the presets."""
    tables: Mapping[str, Mapping[str, Mapping[str, Any]]]
    """What it puts into the recipe, by kind of worlds and table."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """One training run. Runs of a study differ in what stands here, and in nothing else."""

    name: str
    """What its folder and its row are called."""
    asks: str
    """What it is for."""
    network: Mapping[str, Any] = field(default_factory=dict)
    loss: Mapping[str, Any] = field(default_factory=dict)
    protocol: Mapping[str, Any] = field(default_factory=dict)
    """What it has in place of other settings of `TrainConfig`."""
    seed: int = 0
    share: float = 1.0
    """Its part of the study's budget of maps."""
    samples: float = 1.0
    """Its part of the training samples."""
    worlds: str = ""
    """The name of the worlds that it is trained and measured on, or "" for the presets."""
    probability: float = Thresholds().probability
    """Where the bench takes a voxel for occupied."""
    against: str | None = None
    """The run that it is compared with: it has all else in common with this one."""

    def config(self, maps: int) -> TrainConfig:
        """The run's settings at a study's budget of `maps` seen."""
        return TrainConfig(
            network=NetworkConfig(**self.network),
            loss=LossConfig(**self.loss),
            maps=max(round(maps * self.share), 1),
            seed=self.seed,
            **self.protocol,
        )


LEVEL = {"occupancy": 1.0}
BOTH = ("observed", "free")
CLAIMED = (
    Run(name="occ", asks="the paper's OCC-only", network={"variant": "occ"}),
    Run(name="proposed", asks="the paper's network, λ_occ 0.1"),
    Run(name="proposed-1", asks="λ_occ 1: distances leave occupancy its share", loss=LEVEL),
    Run(name="tudf", asks="the paper's TUDF-only", network={"variant": "tudf"}),
)
COLUMNS = Run(
    name="columns",
    asks="columns seen whole, free space",
    network={"variant": "columns", "inputs": BOTH},
    loss=LEVEL,
)
PLAIN = replace(
    CLAIMED[1],
    name="no-eikonal",
    asks="the paper's without the Eikonal term",
    loss={"eikonal": 0.0},
)
RUNS = tuple(
    replace(run, name=f"{run.name}-s{seed}", seed=seed)
    for seed in range(max(SEEDS.values()))
    for run in (*CLAIMED, PLAIN, COLUMNS)
    if seed < SEEDS.get(run.name, LEAST_SEEDS)
)
"""Runs that verdicts compare, with the whole budget; `benchmarks/study.py` adds shorter ones."""
