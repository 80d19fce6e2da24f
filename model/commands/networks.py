"""`scenegen export` and `calibrate`: networks as ONNX, and how sure one may be."""

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import rich_click as click

from scenegen.cli.options import (
    command,
    datasets_argument,
    executing,
    find_datasets,
    out_option,
    printing,
    split_option,
)
from scenegen.cli.show import Progress, Tell, announce_compilation, say
from scenegen.limits import MOST_SAMPLES
from scenegen.model.commands.weights import Weights
from scenegen.model.config import DEFAULT_NETWORK, split_own


@command("export", "export runs/mine -o mine.onnx")
@click.argument("weights", type=Weights(), default=DEFAULT_NETWORK)
@out_option("File to write.  [default: <name>.onnx]", ".onnx")
def export(weights: str, out: Path | None) -> None:
    """Write a network as ONNX, for the runtimes that are fastest on CPUs."""
    from scenegen.model.completion.completer import open_network
    from scenegen.model.onnx import export_onnx

    network, grid, about = open_network(weights)
    out = out or Path(f"{Path(split_own(weights)[1]).stem}.onnx")
    export_onnx(network, grid, out, about=about)
    say(f"written: {out}")


@command("calibrate columns data/pillar -o mine.safetensors", "calibrate runs/mine")
@click.argument("weights", type=Weights())
@datasets_argument
@split_option("val", help="The split whose worlds are looked at; one that no training saw.")
@click.option(
    "--samples", type=click.IntRange(1, MOST_SAMPLES), help="At most so many maps of each dataset."
)
@out_option(
    "File to write.  [default: the network's own; <name>.safetensors of a bundled one, or hf://…]",
    file=True,
)
@executing
@printing
def calibrate(
    weights: str,
    datasets: tuple[Path | str, ...],
    out: Path | None,
    tell: Tell,
    talk: bool,
    **options: Any,
) -> None:
    """Calibrate a network's probabilities; the calibration is kept in its file."""
    from scenegen.files import check_ours, make_parent
    from scenegen.model.checkpoint import CheckpointError
    from scenegen.model.completion.completer import HUB, called, locate
    from scenegen.model.config import bundled
    from scenegen.model.evaluation.calibrate import calibrate as fit

    path = locate(weights)
    if path.suffix == ".onnx":
        raise CheckpointError(
            f"{path}: an exported network; calibrate its .safetensors file, then export that again"
        )
    plain = split_own(weights)[1]
    elsewhere = plain in bundled() or plain.startswith(HUB)
    if out is None and elsewhere:
        out = Path(f"{called(weights, path)}.safetensors")
        check_ours(out)
    out = out or path
    make_parent(out)
    if talk:
        announce_compilation()
    folders = find_datasets(datasets, shown=talk)
    calibration = fit(weights, folders, out, **options, progress=partial(Progress, shown=talk))
    if tell(asdict(calibration)):
        say(f"{calibration.worlds} worlds: temperature {calibration.temperature:.3f}")
        say(f"written: {out}")
