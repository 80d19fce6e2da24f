"""`scenegen complete`: predictions of a dataset's split, of one scan, of a folder of scans, or of a
log.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from scenegen.base.errors import DatasetError, DiskError, printable
from scenegen.base.executors import Executor, executor
from scenegen.base.files import claim, real_path, write_result
from scenegen.base.limits import MAX_BATCH
from scenegen.base.paths import DATA, check_type, type_of
from scenegen.cli.bench import Weights
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
from scenegen.cli.show import ProgressBar, echo, info
from scenegen.cli.types import DatasetPath, Number, OutputFile
from scenegen.model.config import DEFAULT_NETWORK

if TYPE_CHECKING:
    from scenegen.dataset.read import AnyDataset
    from scenegen.model.completion.completer import Completer
    from scenegen.model.completion.scans import Task


COMPLETIONS = "completions.json"
"""File in a folder of completions that records their scans and their network."""


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
    type=click.IntRange(1, MAX_BATCH),
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

    \f
    Args:
        source: A dataset, a scan, a folder of scans, or a log.
        weights: Name of the network.
        split: Split of a dataset.
        out: File or folder to write; see --out for the default.
        device: Device of the network.
        batch: Maps that are completed at once.
        workers: Number of processes, with --workers or --on.
        on: Machines that complete, with --on.
        quiet: Whether nothing but errors is printed.
        sensor: Position of a scan's sensor, metres.
        every: Complete every n-th scan of a folder or a log.
        columns: Number of columns of .bin files, or None.
        log_reading: Options that read logs.

    Raises:
        ScenegenError: if the source or the network is missing, damaged, or does not fit, or if the
            disk refuses.
    """
    # imported here: some of these load torch, which help pages do without
    from scenegen.dataset.collection import open_data
    from scenegen.dataset.locate import locate
    from scenegen.model.completion.completer import Completer
    from scenegen.model.completion.scans import (
        predict_scan,
        read_line,
        read_scan,
        summary,
        tasks_of,
    )
    from scenegen.model.training.device import choose_device

    elsewhere = was_given("on") or was_given("workers")
    # several processes complete on processors, unless the user names another device
    device_here = choose_device("cpu" if elsewhere and device == "auto" else device)
    execute = executor(on, workers if device_here.type == "cpu" else 1) if elsewhere else None
    path = locate(source, show_progress=not quiet)
    check_type(path, *DATA, "log", "scans", "map", "scan")
    name = type_of(path)
    if name == "map":
        raise DatasetError(
            f"{path}: is a map; see it first: `scenegen generate --scene {path} --n 24`, then "
            "complete that dataset"
        )
    stored = name in DATA
    if execute is not None and path.exists() and not stored:
        raise DatasetError(
            f"{path}: --on and --workers complete a dataset's split; leave them out for scans"
        )
    logged = not stored and (name == "log" or log_reading["poses"] is not None)
    if not logged and (unused := [name for name, value in log_reading.items() if value]):
        raise DatasetError(f"{path}: is no log; leave out --{unused[0].replace('_', '-')}")
    several = logged or (not stored and path.is_dir())
    # before the network is opened, since this may refuse the source at once
    tasks = tasks_of(path, sensor, every, columns, **log_reading) if several else None
    if tasks and tasks[2] and not quiet:
        info(tasks[2])
    completer = Completer.from_pretrained(weights, device=device_here, batch=batch)
    if tasks:
        name = path.stem if path.is_file() else real_path(path).name  # `.` has no name
        out = out or Path(f"{name}.completed")
        options = {"sensor": sensor, "columns": columns, **log_reading}
        identity = {name: str(value) for name, value in options.items() if value is not None}
        identity |= {"source": str(real_path(path)), "weights": completer.digest}
        # completions of other scans or by another network are refused, not kept as these
        claim(out, COMPLETIONS, identity)
        complete_scans(completer, tasks[0], tasks[1], out, quiet)
        return
    out = out or (Path("predictions") if stored else path.with_suffix(".completed.h5"))
    existed = out.is_file()
    if stored:
        _complete_split(completer, open_data(path), split, out, execute, quiet)
    else:
        reports = [predict_scan(completer, read_scan(path, sensor, columns), out)]
        if not quiet:
            info(read_line(reports))
            lines = "; ".join(summary(completer, reports))
            echo(f"{path}: {lines}; completed by {completer.name}")
    if not quiet:
        echo(f"{'replaced' if existed else 'written'}: {out}")


def _complete_split(
    completer: "Completer",
    dataset: "AnyDataset",
    split: str,
    out: Path,
    execute: Executor | None,
    quiet: bool,
) -> None:
    """Complete a dataset's split into the folder `out`, and note differences from the training.
    Raises DatasetError if `out` is the name of a file."""
    if out.suffix == ".h5":
        raise DatasetError(f"{out}: a dataset's predictions are a folder; give a name without .h5")
    from scenegen.model.calibration import UNUSUAL
    from scenegen.model.completion.predictions import predict_split

    with ProgressBar("complete", visible=not quiet) as progress:
        away, damaged = predict_split(
            completer,
            dataset,
            split,
            out,
            execute=execute,
            on_start=progress.start,
            on_done=progress.count,
        )
    for name in damaged:
        info(f"{out / name}: was not as it was written; it was completed again")
    for warning in () if quiet else completer.unlike(dataset.settings):
        info(f"note: {warning}")
    far = sum(share >= UNUSUAL for share in away)
    if not quiet and far > 2 * (1 - UNUSUAL) * len(away):  # half of this is expected
        info(
            f"note: {far} of {len(away)} maps are away from home for {completer.name}: it "
            f"denies more of their returns than of {UNUSUAL:.0%} of the maps it was calibrated "
            f"on, so expect worse completions"
        )


def complete_scans(
    completer: "Completer", count: int, scans: "Iterable[Task]", out: Path, quiet: bool
) -> None:
    """Complete scans into files of a folder, and write a page that shows some of them.

    Intact files of an earlier run are not written again.

    Args:
        completer: The network.
        count: Number of scans.
        scans: The scans, each with a name and a function that reads it.
        out: The folder; each scan becomes NAME.h5.
        quiet: Whether nothing but errors is printed.

    Raises:
        DiskError: if the disk refuses; at once.
        DatasetError: if scans could not be completed; after all others were.
    """
    from scenegen.model.completion.scans import (
        about_scan,
        is_intact,
        looks_of_completions,
        predict_scan,
        read_line,
        summary,
    )
    from scenegen.view.page import page

    reports, completions, failed = list[Any](), list[Path](), 0
    with ProgressBar("complete", visible=not quiet) as progress:
        progress.start(count)
        for name, read in scans:
            target = out / f"{name}.h5"
            intact = target.exists() and is_intact(target, about_scan(completer, name))
            if target.exists() and not intact:
                info(f"{target}: is damaged, or of another scan; it is completed again")
                target.unlink()
            if not intact:
                try:
                    reports.append(predict_scan(completer, read(), target, name=name))
                # the next file would fail, too
                except DiskError:
                    raise
                except DatasetError as error:
                    failed += 1
                    info(printable(error))
            if target.exists():
                completions.append(target)
            progress.count(1)
    if completions:
        looks = looks_of_completions(completions)
        known = any("occupancy" in look.masks for look in looks)
        notes = ["Where the log knows nothing, predictions are not shown."] * known
        write_result(out / "index.html", page(looks, title=str(out), notes=notes).encode())
    if failed:
        raise DatasetError(
            f"{out}: {failed} of {count} scans could not be completed; the others are there"
        )
    if quiet:
        return
    if reports:
        info(read_line(reports))
        for line in summary(completer, reports):
            info(f"note: {line}")
    echo(f"{out}: {len(completions)} completions; look at {out / 'index.html'}")
