"""`scenegen complete`: predictions of a dataset's split, of one scan, of a folder of scans, or of a
log."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from scenegen.cli.options import (
    columns_option,
    command,
    device_option,
    group,
    log_options,
    on_option,
    quiet_option,
    split_option,
    was_given,
    workers_by,
)
from scenegen.cli.show import Progress, note, say
from scenegen.cli.types import DatasetPath, Number, OutputFile
from scenegen.errors import DatasetError
from scenegen.limits import MOST_BATCH
from scenegen.model.commands.weights import Weights
from scenegen.model.config import DEFAULT_NETWORK
from scenegen.run import Executor, executor

if TYPE_CHECKING:
    from scenegen.model.completion.completer import Completer

COMPLETIONS = "completions.json"
"""The file of a folder of completions that says of which scans they are, and whose."""
MAX_SHOWN = 24
"""Completions on the page of a folder or a log, evenly spread."""


@command(
    "complete data/pillar --weights columns --split test -o predictions",
    "complete scan.ply --sensor 0 0 1.2",
    "complete kitti/sequences/00/velodyne -o completed",
    "complete drive.mcap --every 10 -o completed",
)
@click.argument("source", type=DatasetPath())
@click.option(
    "--weights",
    type=Weights(),
    default=DEFAULT_NETWORK,
    help="A bundled name, a file, a run's folder, hf://…",
)
@split_option("test", help="The split of a dataset that is completed.")
@click.option(
    "-o",
    "--output",
    "--out",
    "out",
    type=OutputFile(folders=True),
    help="File to write; of a dataset, a folder of scans or a log, a folder.  [default: "
    "predictions, or <scan>.completed.h5]",
)
@click.option(
    "--sensor",
    type=(Number(), Number(), Number()),
    default=(0.0, 0.0, 0.0),
    help="Where a scan's sensor was: X Y Z, m.",
)
@columns_option
@click.option(
    "--every",
    type=click.IntRange(1, 10**6),
    default=1,
    help="Complete every n-th scan of a folder or a log.",
)
@log_options
@device_option
@click.option(
    "--batch",
    type=click.IntRange(1, MOST_BATCH),
    default=8,
    help="Maps at once.",
)
@workers_by("1; with --on, all cores")
@on_option
@quiet_option
@group("Scans and logs", "sensor columns every poses poses-of topic fixed-frame")
def complete(
    source: Path | str,
    weights: str,
    split: str,
    out: Path | None,
    device: str,
    batch: int,
    workers: int,
    on: str,
    quiet: bool,
    sensor: tuple[float, ...],
    every: int,
    columns: int | None,
    log_reading: dict[str, Any],
) -> None:
    """Complete a dataset's split, a scan, all scans in a folder and below it, or a log.

    Scans are .ply, .pcd, .bin, .npz, .xyz, .npy, .las or .laz: points in metres, z up. A log is
    what `ingest` takes: a recording of ROS, or a folder with poses, such as a
    sequence of KITTI's; its scans are turned upright by their poses. A page shows some completions
    where there are several. Given a dataset again after a stop, it goes on where
    it was. One process completes; with --on or --workers, so many do, each on one thread of a
    processor unless --device says more.
    """
    from scenegen.dataset.locate import locate
    from scenegen.dataset.manifest import NAME
    from scenegen.files import claim, real_path
    from scenegen.logs.read import is_log
    from scenegen.model.completion.completer import Completer
    from scenegen.model.completion.scans import (
        complete_all,
        predict_scan,
        read_line,
        read_scan,
        summary,
        tasks_of,
    )
    from scenegen.model.training.device import choose_device
    from scenegen.worlds import is_map

    elsewhere = was_given("on") or was_given("workers")
    device_here = choose_device("cpu" if elsewhere and device == "auto" else device)
    execute = executor(on, workers if device_here.type == "cpu" else 1) if elsewhere else None
    path = locate(source, shown=not quiet)
    if is_map(path):
        raise DatasetError(
            f"{path}: is a map; see it first: `scenegen generate --scene {path} --n 24`, then "
            "complete that dataset"
        )
    stored = (path / NAME).exists()
    if execute is not None and path.exists() and not stored:
        raise DatasetError(
            f"{path}: --on and --workers complete a dataset's split; leave them out for scans"
        )
    logged = not stored and (is_log(path) or log_reading["poses"] is not None)
    if not logged and (unused := [name for name, value in log_reading.items() if value]):
        raise DatasetError(f"{path}: is no log; leave out --{unused[0].replace('_', '-')}")
    several = logged or (not stored and path.is_dir())
    # which may refuse what is there at once
    tasks = tasks_of(path, sensor, every, columns, quiet, **log_reading) if several else None
    completer = Completer.from_pretrained(weights, device=device_here, batch=batch)
    if tasks:
        name = path.stem if path.is_file() else real_path(path).name
        out = out or Path(f"{name}.completed")
        options = {"sensor": sensor, "columns": columns, **log_reading}
        about = {name: str(value) for name, value in options.items() if value is not None}
        about |= {"source": str(real_path(path)), "weights": completer.digest}
        claim(out, COMPLETIONS, about)
        complete_all(completer, tasks, out, MAX_SHOWN, quiet)
        return
    out = out or (Path("predictions") if stored else path.with_suffix(".completed.h5"))
    existed = out.is_file()
    if stored:
        _complete_split(completer, path, split, out, execute, quiet)
    else:
        reports = [predict_scan(completer, read_scan(path, sensor, columns), out)]
        if not quiet:
            note(read_line(reports))
            lines = "; ".join(summary(completer, reports))
            say(f"{path}: {lines}; completed by {completer.name}")
    if not quiet:
        say(f"{'replaced' if existed else 'written'}: {out}")


def _complete_split(
    completer: "Completer",
    folder: Path,
    split: str,
    out: Path,
    execute: Executor | None,
    quiet: bool,
) -> None:
    """Complete a dataset's split into the folder `out`, and say where its maps are unlike those of
    training. Raises DatasetError where `out` is called as a file."""
    if out.suffix == ".h5":
        raise DatasetError(f"{out}: a dataset's predictions are a folder; give a name without .h5")
    from scenegen.dataset.read import Dataset
    from scenegen.model.calibration import UNUSUAL
    from scenegen.model.completion.predictions import predict_split

    progress = partial(Progress, shown=not quiet)
    away, damaged = predict_split(completer, folder, split, out, execute=execute, progress=progress)
    for name in damaged:
        note(f"{out / name}: was not as it was written; it was completed again")
    for warning in () if quiet else completer.unlike(Dataset(folder).settings):
        note(f"note: {warning}")
    far = sum(share >= UNUSUAL for share in away)
    if not quiet and far > 2 * (1 - UNUSUAL) * len(away):  # at home, it would be half of that
        note(
            f"note: {far} of {len(away)} maps are away from home for {completer.name}: it "
            f"denies more of their returns than of {UNUSUAL:.0%} of the maps it was calibrated "
            f"on, so expect worse completions"
        )
