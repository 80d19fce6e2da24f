"""What the study trains: every run by name."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any

import numpy as np

from scenegen.model.calibration import corrected
from scenegen.model.config import PROTOCOLS, LossConfig, NetworkConfig, Thresholds, TrainConfig

SEEDS = {"occ": 3, "proposed": 3, "proposed-1": 3}
"""How many seeds the runs have that a verdict compares, where it is not `LEAST_SEEDS`: no ordering
is claimed from one."""
LEAST_SEEDS = 2
SHORT = 0.25
"""The part of the budget that a run has where it shows what one choice is worth, and where its
opposite has as much."""

BOTH = ("observed", "free")


@dataclass(frozen=True, kw_only=True)
class Elsewhere:
    """Worlds, or truth, other than the presets'."""

    asks: str
    """What is unlike the presets."""
    tables: Mapping[str, Mapping[str, Mapping[str, Any]]]
    """What it puts into the recipe, by kind of worlds and table."""


def _alike(**tables: Mapping[str, Any]) -> Mapping[str, Mapping[str, Mapping[str, Any]]]:
    return dict.fromkeys(KINDS, tables)


KINDS = ("geometric", "pillar")
"""The kinds of worlds that every network is trained on."""
ELSEWHERE = {
    "ground": Elsewhere(
        asks="a ground below pillars, none below loose solids",
        tables={"geometric": {"world": {"ground": False}}, "pillar": {"world": {"ground": True}}},
    ),
    "sparse": Elsewhere(
        asks="half as many obstacles",
        tables={
            "geometric": {"world": {"density": [0.001, 0.2]}},
            "pillar": {"world": {"density": [0.025, 0.05]}},
        },
    ),
    "hollow": Elsewhere(
        asks="truth of surfaces alone, as of meshes", tables=_alike(grid={"hollow": True})
    ),
    "band": Elsewhere(
        asks="every ray 30° lower, in place of a tilted sensor",
        tables=_alike(lidar={"mount": "band"}),
    ),
}
"""Where the study trains a pair of networks, too: what our reading of the paper leaves open, each
tried alone."""


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
    """What it is trained and measured on: a name of `ELSEWHERE`, or "" for the presets."""
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


def _runs() -> tuple[Run, ...]:
    level, both = {"occupancy": 1.0}, {"inputs": BOTH}
    claimed = (
        Run(name="occ", asks="the paper's OCC-only", network={"variant": "occ"}),
        Run(name="proposed", asks="the paper's network, λ_occ 0.1"),
        Run(
            name="proposed-1",
            asks="λ_occ 1: whether distances leave occupancy its share",
            loss=level,
        ),
        Run(name="tudf", asks="the paper's TUDF-only", network={"variant": "tudf"}),
    )
    columns = Run(
        name="columns",
        asks="columns seen whole, free space",
        network={"variant": "columns", **both},
        loss=level,
    )
    plain = replace(
        claimed[1],
        name="no-eikonal",
        asks="the paper's without the Eikonal term",
        loss={"eikonal": 0.0},
    )
    long = [
        replace(run, name=f"{run.name}-s{seed}", seed=seed)
        for seed in range(max(SEEDS.values()))
        for run in (*claimed, plain, columns)
        if seed < SEEDS.get(run.name, LEAST_SEEDS)
    ]
    occ, proposed, proposed_1, columns = (
        replace(run, name=f"{run.name}-short", asks=f"{run.asks}, a part of the maps", share=SHORT)
        for run in (*claimed[:3], columns)
    )

    proposed = replace(proposed, against=occ.name)

    def unlike(base: Run, name: str, asks: str, **changed: Any) -> Run:
        return replace(base, name=name, asks=asks, against=base.name, **changed)

    short = [
        occ,
        proposed,
        proposed_1,
        columns,
        unlike(proposed, "dual", "without CrossFusion", network={"variant": "dual"}),
        unlike(proposed_1, "dual-1", "without CrossFusion at λ_occ 1", network={"variant": "dual"}),
        unlike(proposed, "shared", "one decoder with two heads", network={"variant": "shared"}),
        unlike(proposed_1, "shared-1", "the same at λ_occ 1", network={"variant": "shared"}),
        unlike(columns, "columns-observed", "without free space", network={"variant": "columns"}),
        unlike(
            columns,
            "flat",
            "without the 3-D net, as in LMSCNet",
            network={"variant": "flat", **both},
        ),
        unlike(
            proposed,
            "proposed-scaled",
            "distances in units of the truncation",
            loss={"beta_m": 2.0, "tudf": 0.5, "eikonal": 0.1},
        ),
        unlike(proposed, "proposed-paper", "the paper's protocol", protocol=PROTOCOLS["paper"]),
        unlike(proposed, "proposed-plain", "without symmetries", protocol={"augment": False}),
        unlike(
            occ,
            "occ-wide",
            "with as many parameters as `proposed`",
            network={"variant": "occ", "width": 11},
        ),
        unlike(
            occ,
            "occ-weight-1",
            "no class weight, and a threshold that undoes it",
            loss={"occupied_weight": 1.0},
            probability=EVEN_THRESHOLD,
        ),
        unlike(proposed, "proposed-stem-1", "a finer stem", network={"stem_stride": 1}),
        unlike(proposed_1, "proposed-1-of-10", "one of 10 samples", samples=0.1),
    ]
    there = [
        replace(occ, name=f"occ-{name}", asks=worlds.asks, worlds=name)
        for name, worlds in ELSEWHERE.items()
    ]
    pairs = [
        (run, unlike(run, f"proposed-{run.worlds}", "the paper's network there", network={}))
        for run in there
    ]
    return (*long, *short, *chain.from_iterable(pairs))


EVEN_THRESHOLD = float(
    corrected(np.array(Thresholds().probability, np.float32), LossConfig().occupied_weight)
)
"""Where a network without a class weight stands when one with the paper's says the paper's
threshold."""
RUNS = _runs()
"""All runs of the study, those that decide most first."""
