"""`scenegen complete`: predictions of a dataset's split, of one scan, of a folder of scans, of a
log, or of what a sensor sees in a map."""

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
    from scenegen.dataset.read import AnyDataset
    from scenegen.model.completion.completer import Completer

COMPLETIONS = "completions.json"
"""The file of a folder of completions that says of which scans they are, and whose."""
MOST_SHOWN = 24
"""Completions on the page of a folder, a log or a map, evenly spread."""


@command(
    "complete data/pillar --weights columns --split test -o predictions",
    "complete scan.ply --sensor 0 0 1.2",
    "complete kitti/sequences/00/velodyne -o completed",
    "complete drive.mcap --every 10 -o completed",
    "complete campus.bt --n 50 -o completed",
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
    help="File to write; of a dataset, a folder of scans, a log or a map, a folder.  [default: "
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
@click.option(
    "--n", "count", type=click.IntRange(1, 10**6), default=MOST_SHOWN, help="Viewpoints in a map."
)
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
@group("Scans, logs and maps", "n sensor columns every poses poses-of topic fixed-frame")
def complete(
    source: Path | str,
    weights: str,
    split: str,
    out: Path | None,
    count: int,
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
    """Complete a dataset's split, a scan, all scans in a folder and below it, a log, or a map.

    Scans are .ply, .pcd, .bin, .npz, .xyz, .npy, .las or .laz: points in metres, z up. A log is
    what `ingest` takes: a recording of ROS, or a folder with poses, such as a
    sequence of KITTI's; its scans are turned upright by their poses. Through a map (.bt, .ot, or
    .npz of `scenegen map`), the paper's sensor flies, and what it sees is completed. A page shows
    some completions where there are several. Given a dataset again after a stop, it goes on where
    it was. One process completes; with --on or --workers, so many do, each on one thread of a
    processor unless --device says more.
    """
    from scenegen.dataset.locate import locate
    from scenegen.dataset.opening import COLLECTION, open_data
    from scenegen.dataset.schema import NAME
    from scenegen.files import claim, real_path
    from scenegen.logs.read import is_log
    from scenegen.model.completion.completer import Completer
    from scenegen.model.completion.scans import (
        complete_all,
        predict_scan,
        read_line,
        read_scan,
        tasks_of,
    )
    from scenegen.model.training.device import choose_device
    from scenegen.worlds import is_map

    elsewhere = was_given("on") or was_given("workers")
    device_here = choose_device("cpu" if elsewhere and device == "auto" else device)
    execute = executor(on, workers if device_here.type == "cpu" else 1) if elsewhere else None
    path = locate(source, shown=not quiet)
    stored = path.suffix == ".json" or (path / COLLECTION).exists()
    stored = stored or (path / NAME).exists() or any(path.glob(f"*/{NAME}"))
    if execute is not None and path.exists() and not stored:
        raise DatasetError(
            f"{path}: --on and --workers complete a dataset's split; leave them out for scans"
        )
    logged = not stored and (is_log(path) or log_reading["poses"] is not None)
    if not logged and (given := [name for name, value in log_reading.items() if value]):
        raise DatasetError(f"{path}: is no log; leave out --{given[0].replace('_', '-')}")
    several = logged or (not stored and path.is_dir())
    # which may refuse what is there at once
    tasks = tasks_of(path, sensor, every, columns, quiet, **log_reading) if several else None
    completer = Completer.from_pretrained(weights, device=device_here, batch=batch)
    if tasks or is_map(path):
        name = path.stem if path.is_file() else real_path(path).name
        out = out or Path(f"{name}.completed")
        if tasks:
            options = {"sensor": sensor, "columns": columns, **log_reading}
            about = {name: str(value) for name, value in options.items() if value is not None}
            about |= {"source": str(real_path(path)), "weights": completer.digest}
            claim(out, COMPLETIONS, about)
            complete_all(completer, tasks, out, MOST_SHOWN, quiet)
        else:
            _complete_map(completer, path, count, out, quiet)
        return
    out = out or (Path("predictions") if stored else path.with_suffix(".completed.h5"))
    existed = out.is_file()
    if stored:
        _complete_split(completer, open_data(path), split, out, execute, quiet)
    else:
        completed = predict_scan(completer, read_scan(path, sensor, columns), out)
        if not quiet:
            note(read_line([completed]))
            say(f"{path}: {completed}; completed by {completer.name}")
    if not quiet:
        say(f"{'replaced' if existed else 'written'}: {out}")


def _complete_split(
    completer: "Completer",
    dataset: "AnyDataset",
    split: str,
    out: Path,
    execute: Executor | None,
    quiet: bool,
) -> None:
    """Complete a dataset's split into the folder `out`, and say where its maps are unlike those of
    training. Raises DatasetError where `out` is called as a file."""
    if out.suffix == ".h5":
        raise DatasetError(f"{out}: a dataset's predictions are a folder; give a name without .h5")
    from scenegen.model.calibration import UNUSUAL
    from scenegen.model.completion.predictions import predict_split

    progress = partial(Progress, shown=not quiet)
    away = predict_split(completer, dataset, split, out, execute=execute, progress=progress)
    for warning in () if quiet else completer.unlike(dataset.settings):
        note(f"note: {warning}")
    far = sum(one >= UNUSUAL for one in away)
    if not quiet and far > 2 * (1 - UNUSUAL) * len(away):  # at home, it would be half of that
        note(
            f"note: {far} of {len(away)} maps are away from home for {completer.name}: it "
            f"denies more of their returns than of {UNUSUAL:.0%} of the maps it was calibrated "
            f"on, so expect worse completions"
        )


def _complete_map(completer: "Completer", place: Path, count: int, out: Path, quiet: bool) -> None:
    """Fly a sensor through a map, into the dataset `out`/seen; complete what it saw, and write a
    page of some. Raises DatasetError where `out` holds others: `build` would add to them."""
    from scenegen.dataset.build import build
    from scenegen.dataset.generation import plan_generation
    from scenegen.dataset.manifest import load
    from scenegen.dataset.read import Dataset
    from scenegen.dataset.schema import NAME
    from scenegen.model.commands.view import write_page
    from scenegen.model.commands.weights import chosen

    there, predictions = out / "seen", out / "predictions"
    (plan,) = plan_generation(n=count, scene=place, out=there).datasets
    if (there / NAME).exists() and load(there).parameters != plan.manifest.parameters:
        raise DatasetError(f"{out}: holds another map, or another --n of it; give another -o")
    build(plan)
    seen = Dataset(there)
    _complete_split(completer, seen, "train", predictions, None, quiet)
    guesses, _ = chosen(seen, "train", predictions, (), 0, no_paths=True)
    write_page(seen, "train", (), MOST_SHOWN, out / "index.html", quiet, guesses)
