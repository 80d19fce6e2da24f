"""Train the networks of the replication, one after the other; see PLAN.md.

    OMP_NUM_THREADS=1 nice -n 19 python benchmarks/paper/train.py ROOT
    python benchmarks/paper/train.py ROOT --dry-run

ROOT holds `data/` and `runs/`; what is missing there is made. A stopped run continues from the
minute it was saved. Several of these commands may work on one ROOT: each takes the next run that no
other process works on.
"""

import csv
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

import scenegen
from scenegen.base.errors import DatasetError, ScenegenError
from scenegen.model.config import PROTOCOLS, TrainConfig
from scenegen.model.training.data import opened
from scenegen.model.training.loop import Watcher, train

KINDS = {
    "geometric": "278fdd4e039fa46b6645c4b43e22a80d523d815fe1e4791390da01609080455c",
    "pillar": "5ff3a8fc6b253fbf8d29ba6bbc82b2272040c665b18361fbb850f9ec642931a2",
}
"""Digests of the datasets, by kind of worlds."""
ORDER = [
    *(f"{variant}-s{seed}" for seed in (0, 1) for variant in ("occ", "proposed")),
    *("tudf-s0", "tudf-s1"),
    *(f"{variant}-s2" for variant in ("occ", "proposed", "tudf")),
]
"""Runs in the order of the plan."""
MAPS_PER_SECOND = {"proposed": 11.4, "occ": 22.0, "tudf": 21.0}
"""On one thread of an AMD EPYC, float32."""
TRAIN_MAPS, USUAL_EPOCHS = 5000, 50


@dataclass
class Options:
    """What to train, and where."""

    root: tyro.conf.Positional[Path]
    """folder with `data/` and `runs/`"""
    runs: tuple[str, ...] = tuple(ORDER)
    """names of runs, METHOD-sSEED"""
    dry_run: bool = False
    """say what is done and what is left, in hours, and end"""


def config_of(name: str) -> TrainConfig:
    """The settings of the run `name`, METHOD-sSEED."""
    variant, _, seed = name.rpartition("-s")
    return TrainConfig.of(
        PROTOCOLS["paper"] | {"variant": variant, "seed": int(seed), "precision": "float32"}
    )


def rows_of(folder: Path) -> list[dict[str, float]]:
    """Finished epochs of a run, from its metrics.csv; none for a run that has not begun."""
    file = folder / "metrics.csv"
    if not file.exists():
        return []
    with file.open() as lines:
        return [{key: float(value) for key, value in row.items()} for row in csv.DictReader(lines)]


def has_ended(name: str, rows: list[dict[str, float]]) -> bool:
    """Whether a run with these finished epochs met its stopping rule, or its cap."""
    config = config_of(name)
    losses = [row["val_loss"] for row in rows]
    waited = len(losses) - 1 - losses.index(min(losses)) if losses else 0
    return waited >= config.patience or len(rows) >= config.epochs


def make_datasets(root: Path) -> list[Path]:
    """Generate what is missing, and check that the digests are those of the plan."""
    folders = []
    for kind, digest in KINDS.items():
        folder = root / "data" / kind
        scenegen.generate(kind, 2500, out=folder)
        found = json.loads((folder / "dataset.json").read_text())["digest"]
        if found != digest:
            raise DatasetError(f"{folder}: digest {found}, expected {digest}")
        folders.append(folder)
    return folders


def report(options: Options) -> None:
    """Print each run's epochs and the hours that are left of it."""
    total = 0.0
    for name in options.runs:
        rows = rows_of(options.root / "runs" / name)
        ended = has_ended(name, rows)
        epochs = 0 if ended else max(USUAL_EPOCHS - len(rows), 5)
        hours = epochs * TRAIN_MAPS * 1.1 / MAPS_PER_SECOND[name.rpartition("-s")[0]] / 3600
        total += hours
        best = min((row["val_loss"] for row in rows), default=float("nan"))
        state = "ended" if ended else f"{hours:.1f} h left if it takes {len(rows) + epochs} epochs"
        print(f"{name:<12} {len(rows):>3} epochs, lowest validation loss {best:.5f}; {state}")
    print(f"{total:.0f} hours of one thread in all")


def main() -> None:
    """Train every run that no other process works on."""
    options = tyro.cli(Options, description=__doc__)
    if options.dry_run:
        return report(options)
    torch.set_num_threads(1)
    folders = make_datasets(options.root)
    for name in options.runs:
        out = options.root / "runs" / name
        if has_ended(name, rows_of(out)):
            continue

        def on_epoch(row: dict[str, float], name: str = name) -> None:
            clock = time.strftime("%Y-%m-%d %H:%M:%S")
            print(
                f"{clock} {name} epoch {row['epoch']:.0f}: validation loss {row['val_loss']:.5f}, "
                f"IoU {row['val_iou']:.3f}, {row['seconds']:.0f} s",
                flush=True,
            )

        try:
            train(
                opened(folders, "train"),
                opened(folders, "val"),
                config_of(name),
                out,
                device="cpu",
                command=f"benchmarks/paper/train.py, run {name}",
                watcher=Watcher(on_epoch=on_epoch),
            )
        except DatasetError as error:
            if "another process" not in str(error):
                raise
    return None


if __name__ == "__main__":
    try:
        main()
    except ScenegenError as error:
        sys.exit(str(error))
