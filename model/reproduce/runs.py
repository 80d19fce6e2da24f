"""What the study trains: every run by name."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from scenegen.model.config import LossConfig, NetworkConfig, TrainConfig

Row = tuple[str, str, Mapping[str, Any], Mapping[str, Any]]
"""Name without seed, what it is for, network, loss."""
SEEDS = (0, 1)
"""Seeds of the runs that a verdict compares: no ordering is claimed from one."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """One training run. Runs of a study differ in what stands here, and in nothing else."""

    name: str
    """What its folder and its row are called."""
    asks: str
    """What it is for."""
    network: Mapping[str, Any] = field(default_factory=dict)
    loss: Mapping[str, Any] = field(default_factory=dict)
    seed: int = 0
    share: float = 1.0
    """Its part of the study's budget of maps."""

    def config(self, maps: int) -> TrainConfig:
        """The run's settings at a study's budget of `maps` seen."""
        return TrainConfig(
            network=NetworkConfig(**self.network),
            loss=LossConfig(**self.loss),
            maps=max(round(maps * self.share), 1),
            seed=self.seed,
        )


def _runs() -> tuple[Run, ...]:
    level = {"occupancy": 1.0}
    both = {"inputs": ("observed", "free")}
    claimed: list[Row] = [
        ("occ", "the paper's OCC-only", {"variant": "occ"}, {}),
        ("proposed", "the paper's network, λ_occ 0.1", {}, {}),
        ("tudf", "the paper's TUDF-only", {"variant": "tudf"}, {}),
        ("proposed-1", "λ_occ 1: whether distances leave occupancy its share", {}, level),
        ("columns", "columns seen whole, free space, λ_occ 1", {"variant": "columns", **both}, level),
    ]
    single: list[Row] = [
        ("dual", "what CrossFusion is worth", {"variant": "dual"}, {}),
        ("dual-1", "the same at λ_occ 1", {"variant": "dual"}, level),
        ("shared", "what two decoders are worth", {"variant": "shared"}, {}),
        ("shared-1", "the same at λ_occ 1", {"variant": "shared"}, level),
        ("proposed-no-eikonal", "what the Eikonal term is worth", {}, {"eikonal": 0.0}),
        ("proposed-scaled", "distances in units of the truncation", {}, {"beta_m": 2.0, "tudf": 0.5, "eikonal": 0.1}),
        ("occ-wide", "OCC-only with as many parameters as `proposed`", {"variant": "occ", "width": 11}, {}),
        ("tudf-wide", "TUDF-only with as many parameters as `proposed`", {"variant": "tudf", "width": 11}, {}),
        ("occ-weight-1", "OCC-only without the class weight", {"variant": "occ"}, {"occupied_weight": 1.0}),
        ("dual-1-free", "free space as an input", {"variant": "dual", **both}, level),
        ("columns-observed", "columns without free space", {"variant": "columns"}, level),
    ]
    found = [
        Run(name=f"{name}-s{seed}", asks=asks, network=network, loss=loss, seed=seed)
        for seed in SEEDS
        for name, asks, network, loss in claimed
    ]
    found += [Run(name=f"{name}-s0", asks=asks, network=network, loss=loss) for name, asks, network, loss in single]
    finer = {"stem_stride": 1}
    return (
        *found,
        Run(name="proposed-stem-1-s0", asks="a finer stem, a quarter of the maps", network=finer, share=0.25),
    )


RUNS = _runs()
"""All runs of the study, those that decide most first."""
