"""`scenegen complete`: predictions of a dataset's split, or of one scan."""

from pathlib import Path

import rich_click as click

from scenegen.limits import MOST_BATCH
from scenegen.model.commands.weights import Weights
from scenegen.model.config import DEFAULT_NETWORK
from scenegen.terminal.options import device_option, out_option, quiet_option, split_option
from scenegen.terminal.progress import Progress, note
from scenegen.terminal.show import say
from scenegen.terminal.types import DatasetPath, Number


@click.command()
@click.argument("source", type=DatasetPath())
@click.option(
    "--weights",
    type=Weights(),
    default=DEFAULT_NETWORK,
    show_default=True,
    help="A bundled name, a file, a run's folder, hf://…",
)
@split_option("test", help="The split of a dataset that is completed.")
@out_option("File to write.  [default: predictions.h5, or <scan>.completed.h5]", file=True)
@click.option(
    "--sensor",
    type=(Number(), Number(), Number()),
    default=(0.0, 0.0, 0.0),
    help="Where a scan's sensor was: X Y Z, m.",
)
@device_option
@click.option("--batch", type=click.IntRange(1, MOST_BATCH), default=8, show_default=True, help="Maps at once.")
@quiet_option
def complete(
    source: Path | str,
    weights: str,
    split: str,
    out: Path | None,
    sensor: tuple[float, float, float],
    device: str,
    batch: int,
    quiet: bool,
) -> None:
    """Complete a dataset's split, or one scan (.ply, .xyz, .npy: points in metres, z up, sensor at the origin)."""
    from scenegen.dataset.locate import locate
    from scenegen.dataset.read import Dataset
    from scenegen.files import make_parent
    from scenegen.model.completion.completer import Completer
    from scenegen.model.completion.predictions import predict_scan, predict_split
    from scenegen.model.config import Thresholds
    from scenegen.model.training.device import choose_device

    completer = Completer.from_pretrained(weights, device=choose_device(device), batch=batch)
    found = locate(source, shown=not quiet)
    out = out or (Path("predictions.h5") if found.is_dir() else found.with_suffix(".completed.h5"))
    make_parent(out)
    there = out.exists()
    if found.is_dir():
        with Progress("complete", shown=not quiet) as progress:
            predict_split(completer, found, split, out, batch=batch, on_start=progress.start, on_done=progress.count)
        about = Dataset(found).manifest
        if not quiet and (warning := completer.unlike(about.lidar, about.mapping, about.noise_stages)):
            note(f"note: {warning}")
    else:
        used = predict_scan(completer, found, out, sensor=sensor, thresholds=Thresholds())
        if not quiet:
            say(f"{found}: {used}")
    if not quiet:
        say(f"{'replaced' if there else 'written'}: {out}")
