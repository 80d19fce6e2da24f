"""`scenegen complete`: predictions of a dataset's split, of one scan, or of a folder of scans."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import rich_click as click

from scenegen.cli.options import (
    command,
    device_option,
    on_option,
    quiet_option,
    split_option,
    was_given,
    workers_option,
)
from scenegen.cli.show import Progress, note, say
from scenegen.cli.types import DatasetPath, Number, OutputFile
from scenegen.errors import DatasetError, printable
from scenegen.limits import MOST_BATCH
from scenegen.model.commands.weights import Weights
from scenegen.model.config import DEFAULT_NETWORK, POINTS_NETWORK

if TYPE_CHECKING:
    from scenegen.model.completion.completer import Completer


@command(
    "complete data/pillar --weights columns --split test -o predictions.h5",
    "complete scan.ply --sensor 0 0 1.2",
    "complete kitti/sequences/00/velodyne -o completed",
)
@click.argument("source", type=DatasetPath())
@click.option(
    "--weights",
    type=Weights(),
    help="A bundled name, a file, a run's folder, hf://…  "
    f"[default: {DEFAULT_NETWORK}; of points alone, {POINTS_NETWORK}]",
)
@split_option("test", help="The split of a dataset that is completed.")
@click.option(
    "-o",
    "--output",
    "--out",
    "out",
    type=OutputFile(folders=True),
    help="File to write; of a folder of scans, a folder.  [default: predictions.h5, or "
    "<scan>.completed.h5]",
)
@click.option(
    "--sensor",
    type=(Number(), Number(), Number()),
    default=(0.0, 0.0, 0.0),
    help="Where a scan's sensor was: X Y Z, m.",
)
@device_option
@click.option(
    "--batch",
    type=click.IntRange(1, MOST_BATCH),
    default=8,
    help="Maps at once.",
)
@workers_option
@on_option
@quiet_option
def complete(
    source: Path | str,
    weights: str | None,
    split: str,
    out: Path | None,
    sensor: tuple[float, float, float],
    device: str,
    batch: int,
    workers: int,
    on: str,
    quiet: bool,
) -> None:
    """Complete a dataset's split, or a scan, or all scans in a folder and below it, such as a
    sequence of KITTI's.

    Scans are .ply, .pcd, .bin, .npz, .xyz or .npy: points in metres, z up, the sensor at the
    origin. One process completes; with --on or --workers, so many do, each on one thread of a
    processor unless --device says more.
    """
    from scenegen.clouds import scans_in
    from scenegen.dataset.locate import locate
    from scenegen.dataset.manifest import NAME
    from scenegen.dataset.read import Dataset
    from scenegen.files import make_way, real_path
    from scenegen.model.calibration import UNUSUAL
    from scenegen.model.completion.completer import Completer
    from scenegen.model.completion.predictions import predict_scan, predict_split
    from scenegen.model.training.device import choose_device
    from scenegen.run import executor

    elsewhere = was_given("on") or was_given("workers")
    chosen = choose_device("cpu" if elsewhere and device == "auto" else device)
    execute = executor(on, workers if chosen.type == "cpu" else 1) if elsewhere else None
    found = locate(source, shown=not quiet)
    scans = [] if (found / NAME).exists() else scans_in(found) if found.is_dir() else [found]
    usual = POINTS_NETWORK if scans else DEFAULT_NETWORK
    completer = Completer.from_pretrained(weights or usual, device=chosen, batch=batch)
    if execute is not None and found.exists() and not (found / NAME).exists():
        raise DatasetError(
            f"{found}: --on and --workers complete a dataset's split; leave them out for scans"
        )
    if found.is_dir() and scans:
        out = out or Path(f"{real_path(found).name}.completed")
        _complete_all(completer, found, scans, out, sensor, quiet)
        return
    out = out or (Path("predictions.h5") if found.is_dir() else found.with_suffix(".completed.h5"))
    make_way(out)
    there = out.exists()
    if found.is_dir():
        with Progress("complete", shown=not quiet) as progress:
            away = predict_split(
                completer,
                found,
                split,
                out,
                batch=batch,
                execute=execute,
                on_start=progress.start,
                on_done=progress.count,
            )
        for warning in () if quiet else completer.unlike(Dataset(found).settings):
            note(f"note: {warning}")
        far = sum(one >= UNUSUAL for one in away)
        if not quiet and far > 2 * (1 - UNUSUAL) * len(away):  # at home, it would be half of that
            note(
                f"note: {far} of {len(away)} maps are away from home for {completer.name}: it "
                f"denies more of their returns than of {UNUSUAL:.0%} of the maps it was calibrated "
                f"on, so expect worse completions"
            )
    else:
        used = predict_scan(completer, found, out, sensor=sensor)
        if not quiet:
            say(f"{found}: {used}; completed by {completer.name}")
    if not quiet:
        say(f"{'replaced' if there else 'written'}: {out}")


def _complete_all(
    completer: "Completer",
    folder: Path,
    scans: Sequence[Path],
    out: Path,
    sensor: tuple[float, float, float],
    quiet: bool,
) -> None:
    """Complete each of the `scans` in `folder` into a file of the same name, but .h5, in the folder
    `out`.

    Those that are there already are passed over. Raises DatasetError at the end where some could
    not be completed.
    """
    from scenegen.files import make_parent, remove_drafts
    from scenegen.model.completion.predictions import predict_scan

    broken = 0
    targets = {scan: (out / scan.relative_to(folder)).with_suffix(".h5") for scan in scans}
    for parent in {target.parent for target in targets.values()}:
        remove_drafts(parent)
    with Progress("complete", shown=not quiet) as progress:
        progress.start(len(scans))
        for scan, target in targets.items():
            if not target.exists():
                make_parent(target)
                try:
                    predict_scan(completer, scan, target, sensor=sensor)
                except DatasetError as error:
                    broken += 1
                    note(printable(error))
            progress.count(1)
    if broken:
        raise DatasetError(
            f"{folder}: {broken} of {len(scans)} scans could not be completed; the others are in "
            f"{out}"
        )
    if not quiet:
        say(f"{out}: {len(scans)} completions")
