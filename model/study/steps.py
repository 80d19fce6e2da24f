"""From a seed to the study's report, step by step: what is there is kept, what is damaged is made
again."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

import torch

from scenegen.cli.show import Showing, counted
from scenegen.dataset.build import build
from scenegen.dataset.generation import plan_generation
from scenegen.dataset.locate import file_sha256
from scenegen.dataset.read import Dataset
from scenegen.errors import DatasetError
from scenegen.files import Json, make_parent, read_bounded, write_whole
from scenegen.limits import MOST_MANIFEST_BYTES
from scenegen.model.api import train
from scenegen.model.checkpoint import CheckpointError
from scenegen.model.config import BenchConfig
from scenegen.model.evaluation.methods import rows_of
from scenegen.model.evaluation.report import finite
from scenegen.model.evaluation.run import bench_all
from scenegen.model.study.claims import asked, judged, means, to_markdown
from scenegen.model.study.runs import KINDS, RUNS, TRIALS, ReproduceConfig, Run
from scenegen.model.training.card import read_rows
from scenegen.model.training.device import choose_device
from scenegen.model.training.run_folder import BEST, CONFIG, ROWS, RunFolder, check_settings
from scenegen.run import Executor, check_together
from scenegen.run.software import commit
from scenegen.run.workers import ALONE

SETTINGS, STUDY, TEXT = "settings.json", "study.json", "study.md"
CURVE = ("maps", "seconds", "train_loss", "val_loss", "val_occupancy", "val_iou", "val_near_rmse")
"""What is told of every look at validation."""


def reproduce(
    out: Path,
    config: ReproduceConfig,
    runs: Sequence[Run],
    *,
    device: str,
    execute: Executor,
    progress: Showing,
) -> Json:
    """Make the study of `runs` in the folder `out`, or go on with it, and return what
    ``study.json`` holds. `execute` has shards written, networks trained, one thread each, and
    samples measured; on a GPU, this process trains one network after the other.

    Raises ScenegenError where `execute` leaves tasks to others, DatasetError where the folder holds
    a study of other settings, and what its steps raise.
    """
    check_together(execute, "a study takes")
    begin(out, config)
    folders = [_dataset(out / "data" / kind, config, execute, progress) for kind in KINDS]
    where, maps = choose_device(device), config.scaled(config.maps)
    work = partial(_train, out / "runs", folders, maps, str(where))
    trained = ALONE if where.type == "cuda" else execute
    list(counted(trained, progress, work, runs, "networks", maps * len(runs), lambda _: maps))
    networks = [str(out / "runs" / run.name) for run in runs]
    methods = rows_of(("returns", "extrude", "truth", "seen"), networks)
    measured = bench_all(
        list(map(Dataset, folders)),
        methods,
        BenchConfig(trials=config.scaled(TRIALS), seed=config.seed),
        execute=execute,
        progress=lambda kind: progress(f"bench, {kind}"),
    )
    results = {
        "settings": asdict(config),
        "commit": commit(),
        "missing": [run.name for run in RUNS if run not in runs],
        "runs": {run.name: _told(out / "runs" / run.name, run) for run in runs},
        **asked(measured),
        "means": {result.kind: means(result) for result in measured},
        "worlds": {result.kind: len(set(result.worlds.tolist())) for result in measured},
    }
    study = judged(finite(results))
    write_whole(out / STUDY, (json.dumps(study, allow_nan=False) + "\n").encode())
    write_whole(out / TEXT, to_markdown(study).encode())
    return study


def begin(out: Path, config: ReproduceConfig) -> None:
    """Begin in the folder, or go on with what was begun there with the same settings.

    Raises DatasetError where the folder holds a study of other settings, and where the disk
    refuses.
    """
    make_parent(out / SETTINGS)
    there = read_json(out / SETTINGS)
    if there is not None:
        check_settings(out, there, asdict(config))
    elif odd := [name for name in (SETTINGS, STUDY, TEXT) if (out / name).exists()]:
        raise DatasetError(f"{out}: holds {odd[0]}, and no study of ours; choose another --out")
    write_whole(out / SETTINGS, (json.dumps(asdict(config), indent=1) + "\n").encode())


def read_json(path: Path) -> Json | None:
    """A JSON object; None where there is none, or it is damaged."""
    try:
        found = json.loads(read_bounded(path, MOST_MANIFEST_BYTES))
    except (OSError, DatasetError, ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def _dataset(folder: Path, config: ReproduceConfig, execute: Executor, progress: Showing) -> Path:
    """A compact dataset of the kind that the folder is called by, made or gone on with; damaged
    shards are made again."""
    n, val, test = config.counts.values()
    plan = plan_generation(
        folder.name, n, val=val, test=test, out=folder, seed=config.seed, compact=True
    )
    with progress(folder.name) as shown:
        build(
            plan,
            execute=execute,
            on_start=shown.start,
            on_shard=lambda report, fresh: shown.count(report.samples),
        )
    return folder


def _train(folder: Path, datasets: Sequence[Path], maps: int, device: str, run: Run) -> None:
    """Train, or go on; a run that is damaged begins again."""
    if device == "cpu":
        torch.set_num_threads(1)
    out = folder / run.name
    settings = {"optimizer": "adamw", **run.settings, "seed": run.seed, "maps": maps}
    try:
        train(datasets, out=out, device=device, **settings)
    except CheckpointError:
        RunFolder(out).clear()
        train(datasets, out=out, device=device, **settings)


def _told(folder: Path, run: Run) -> Json:
    """What is told of a finished run: what it is for, its settings, hardware, time and curve, its
    network's digest."""
    config = read_json(folder / CONFIG) or {}
    curve = read_rows(folder / ROWS)
    return {
        "asks": run.asks,
        "seed": run.seed,
        "samples": config["settings"]["samples"],
        "maps": curve[-1]["maps"],
        "hours": sum(row["seconds"] for row in curve) / 3600,
        "curve": [{name: row[name] for name in CURVE if name in row} for row in curve],
        "sha256": file_sha256(folder / BEST),
    } | {name: config.get(name) for name in ("settings", "device", "commit")}
