"""How large a study is, and which networks it trains."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lidarsim.parameters import Checked, number
from scenegen.errors import DatasetError, printable
from scenegen.limits import MOST_MAPS, MOST_SEED

STUDY = tomllib.loads(Path(__file__).with_name("study.toml").read_text(encoding="utf-8"))
"""What the study trains and asks: see the file."""
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
    settings: Mapping[str, Any]
    """What it has in place of other settings of `scenegen.train`."""


RUNS = tuple(
    Run(name=f"{name}-s{seed}", seed=seed, asks=method["asks"], settings=method["settings"])
    for seed in range(max(method["seeds"] for method in STUDY["methods"].values()))
    for name, method in STUDY["methods"].items()
    if seed < method["seeds"]
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
