"""`scenegen train`: options become a configuration, and the run is reported."""

import os
import shlex
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from scenegen.base.errors import reraise_as
from scenegen.base.executors import cores
from scenegen.base.limits import MAX_SAMPLES, MAX_SEED
from scenegen.cli import stops
from scenegen.cli.bench import Weights
from scenegen.cli.options import (
    command,
    device_option,
    fields_in,
    find_datasets,
    group,
    options_of,
    out_option,
    printing,
    was_given,
)
from scenegen.cli.show import ProgressBar, Reporter, curve, echo
from scenegen.cli.types import Choice, DatasetPath, Named
from scenegen.model.config import (
    INPUTS,
    LOSSES,
    NETWORKS,
    PROTOCOLS,
    TARGETS,
    UNITS,
    LossConfig,
    NetworkConfig,
    Thresholds,
    TrainConfig,
    split_own,
)

if TYPE_CHECKING:
    from scenegen.model.training.card import Scalars
    from scenegen.model.training.data import Samples


MAX_LOADERS = 8
"""Default of `--workers` on a GPU, at most."""
VAL_MAPS = 500
"""Default of `--val-maps`: maps of a stream's validation split, if no dataset is named."""


class Weighted(click.ParamType):
    """Type of a source of samples with a weight: NAME or NAME=WEIGHT.

    Args:
        of: Type of the name.
        unsaid: Weight of a name without one.
    """

    name = "name[=weight]"

    def __init__(self, of: click.ParamType = click.STRING, unsaid: float | None = 1):
        self.of, self.unsaid = of, unsaid

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[Any, float | None]:
        """Split a text. A name that exists as a path is not split.

        Args:
            value: The text, or a pair from an earlier conversion.
            param: The option.
            ctx: Context of the command.

        Returns:
            Name and weight. The weight's bounds are checked when samples are opened.
        """
        if isinstance(value, tuple):
            return value
        name, sign, weight = value.rpartition("=")
        if not sign or Path(value).exists():
            return self.of.convert(value, param, ctx), self.unsaid
        try:
            return self.of.convert(name, param, ctx), float(weight)
        except ValueError:
            self.fail(f"{value!r}: expected NAME or NAME=WEIGHT, such as pillar=2", param, ctx)

    def shell_complete(self, ctx: Any, param: Any, incomplete: str) -> list[Any]:
        """Complete a name as its type does.

        Args:
            ctx: Context of the command.
            param: The option.
            incomplete: Begin of a name.
        """
        return self.of.shell_complete(ctx, param, incomplete)


@command(
    "train data/geometric data/pillar --variant occ --epochs 50 -o runs/occ",
    "train --stream pillar --stream geometric --maps 200000",
    "train data/mine --weights columns --lr 1e-4 --maps 5000 -o runs/mine",
)
@click.argument(
    "datasets", nargs=-1, type=Weighted(DatasetPath(), unsaid=None), metavar="[DATASET[=WEIGHT]]..."
)
@click.option(
    "--variant",
    type=Named(NETWORKS),
    default=NetworkConfig.variant,
    help=f"The network: {', '.join(NETWORKS.builtin)}, or MODULE:CLASS; docs/own-network.md.",
)
@click.option(
    "--loss",
    "objective",
    type=Named(LOSSES),
    default=LossConfig.objective,
    help="The loss: coupled, the paper's, whose weights are the options below, or MODULE:OBJECT.",
)
@click.option(
    "--protocol",
    type=Choice(list(PROTOCOLS)),
    default=next(iter(PROTOCOLS)),
    help="Defaults of the other options; docs/training.md says how the two differ.",
)
@options_of(
    TrainConfig,
    maps="The budget in maps seen, instead of --epochs.",
    epochs="The budget in passes over the datasets.",
    interval="Maps between two validations, instead of a pass.",
    batch="Maps a step, on all devices together.",
    optimizer="The optimizer.",
    lr="Learning rate after the warm-up.",
    schedule="How the rate falls: once validation stalls or the budget nears its end, or never.",
    patience="Validations without a lower loss after which training has stalled.",
    choose="Which network is kept: lowest validation loss, lowest loss of occupancy, or last.",
    seed="Decides the first weights and the order of samples.",
    augment="Turn maps about the sensor at random, and mirror them where its rays allow it.",
    points_share="Share of maps shown as points alone: rays without a return free nothing.",
    precision="Arithmetic of the network; auto takes bfloat16 where the device has it.",
    compile="Run the network through torch.compile.",
)
@click.option(
    "--input",
    "inputs",
    type=Named(INPUTS),
    multiple=True,
    default=NetworkConfig.inputs,
    help=f"A channel that it takes: {', '.join(INPUTS.builtin)}, or MODULE:FUNCTION; repeatable.",
)
@click.option(
    "--target",
    "targets",
    type=Named(TARGETS),
    multiple=True,
    help="What it predicts besides its variant's occupancy and distances: MODULE:CLASS; "
    "docs/own-network.md; repeatable.",
)
@options_of(NetworkConfig, width="Channels at the first level.")
@click.option(
    "--weights",
    type=Weights(),
    help="Begin with a network's weights: a bundled name, a file, a run's folder, hf://…",
)
@options_of(
    LossConfig,
    "lambda-",
    occupancy="Weight of occupancy in the objective.",
    tudf="Weight of distances in it.",
)
@options_of(
    LossConfig,
    eikonal="Weight of the Eikonal term among distances.",
    occupied_weight="Weight of an occupied voxel; a free one has 1.",
    lovasz="Weight of the IoU's Lovász hinge beside the cross-entropy.",
    beta_m="Where the Smooth-L1 loss turns from a parabola into a line, metres.",
)
@click.option(
    "--stream",
    "streams",
    multiple=True,
    type=Weighted(),
    help="Train on maps drawn anew, of a kind, recipe or scenes: NAME or NAME=WEIGHT; several "
    "times for a mixture.",
)
@click.option(
    "--stream-seed",
    type=click.IntRange(0, MAX_SEED),
    default=0,
    help="Its seed.",
)
@click.option(
    "--val-maps",
    type=click.IntRange(1, MAX_SAMPLES),
    help="Maps of its own to validate on.  [default: 500]",
)
@device_option
@click.option(
    "--workers",
    type=click.IntRange(min=0),
    help="Loader processes.  [default: 0 on a CPU, else up to 8]",
)
@out_option("The run's folder.  [default: runs/<variant>]")
@printing
@group("Network", "variant input target width weights")
@group("Loss", "loss lambda-occupancy lambda-tudf eikonal occupied-weight lovasz beta")
@group(
    "Training",
    "protocol maps epochs interval batch optimizer lr schedule patience choose seed augment "
    "points-share precision compile",
)
@group("Stream", "stream stream-seed val-maps")
def train(
    datasets: tuple[tuple[Path | str, float | None], ...],
    streams: tuple[tuple[str, float], ...],
    stream_seed: int,
    val_maps: int | None,
    protocol: str,
    weights: str | None,
    out: Path | None,
    device: str,
    workers: int | None,
    report_result: Reporter,
    verbose: bool,
    **options: Any,
) -> None:
    """Train the completion network on datasets, or on a stream; under torchrun, on several GPUs.

    Maps of datasets with weights come in proportion to these, however many each holds. Given again
    after a stop, it goes on where it was. With --stream, datasets serve validation alone.

    \f
    Args:
        datasets: Datasets with weights; empty for all in data/.
        streams: Kinds or recipes with weights.
        stream_seed: Seed of the streams.
        val_maps: Maps of the streams for validation, or None.
        protocol: Name of a set of defaults, see `PROTOCOLS`.
        weights: Name of a network to begin with, or None.
        out: Folder of the run; by default runs/VARIANT.
        device: Device of the network.
        workers: Processes that read samples; None for the default.
        report_result: Prints a summary as JSON, if asked for.
        verbose: Whether progress is shown.
        options: Fields of `TrainConfig`, `NetworkConfig` and `LossConfig`.

    Raises:
        UsageError: if options contradict each other.
        ScenegenError: as of `scenegen.model.training.loop.train`.
    """
    from scenegen.model.training.device import choose_device
    from scenegen.model.training.loop import Watcher
    from scenegen.model.training.loop import train as run
    from scenegen.model.training.run_folder import RunFolder

    # of the processes of torchrun, the first prints
    first = int(os.environ.get("RANK", "0")) == 0
    verbose = first and verbose
    if weights is not None:
        _take_settings(weights, options)
    with reraise_as(click.UsageError):
        # a protocol replaces defaults, not what the user gave
        options |= {
            name: value for name, value in PROTOCOLS[protocol].items() if not was_given(name)
        }
        config = TrainConfig.of(options)
    out = out or Path("runs") / config.network.variant.rpartition(":")[2]
    begin = time.monotonic()
    # the loop looks for a stop between two steps
    with ProgressBar(config.network.variant, visible=verbose) as progress, stops.noted() as stop:
        training, validation = _samples(datasets, streams, stream_seed, val_maps, verbose)
        chosen = choose_device(device)
        if workers is None:
            workers = (
                0 if chosen.type == "cpu" else min(MAX_LOADERS, 1 << (cores().bit_length() - 1))
            )
        display = _Display(config.network.variant, progress, verbose)
        rows = run(
            training,
            validation,
            config,
            out,
            device=str(chosen),
            workers=workers,
            command=shlex.join(["scenegen", *sys.argv[1:]]),
            weights=weights,
            watcher=Watcher(
                on_start=display.on_start,
                on_step=display.on_step,
                on_epoch=display.on_epoch,
                stop=stop,
            ),
        )
    best = RunFolder(out).best() or rows[-1]
    seconds = time.monotonic() - begin
    summary = {"folder": str(out), "epochs": len(rows), "best": best, "seconds": seconds}
    if not (first and report_result(summary)):
        return
    if not display.begun:
        echo(f"{out}: this run is complete already; give another --out for another one")
    curves = {"loss": "val_loss", "IoU": "val_iou", "IoU, best threshold": "val_best_iou"}
    for name, column in curves.items() if len(rows) > 1 else ():
        values = [row[column] for row in rows if column in row]  # earlier versions wrote no best
        if values:
            echo(f"validation {name:19}  {curve(values)}  {values[0]:.4f} to {values[-1]:.4f}")
    echo(
        f"best: epoch {best['epoch']:.0f} of {len(rows)}, {_validated(best)}; {out}, "
        f"{seconds:.0f} s"
    )


def _samples(
    datasets: tuple[tuple[Path | str, float | None], ...],
    streams: tuple[tuple[str, float], ...],
    seed: int,
    count: int | None,
    verbose: bool,
) -> tuple[list["Samples"], list["Samples"]]:
    """Return samples for training and validation: of datasets, or of streams with a seed. `count`
    is the number of a stream's maps for validation."""
    from scenegen.model.training.data import opened
    from scenegen.streams.stream import stream

    names = tuple(name for name, _ in datasets)
    if not streams:
        if count is not None or was_given("stream_seed"):
            raise click.UsageError(
                "--stream-seed and --val-maps are a stream's; name one, such as --stream pillar"
            )
        folders = find_datasets(names, show_progress=verbose)
        weights = [weight for _, weight in datasets] or [None] * len(folders)
        return opened(list(zip(folders, weights, strict=True)), "train"), opened(folders, "val")
    if datasets and count is not None:
        raise click.UsageError(
            "--val-maps validates on the stream, and datasets are named; leave one of the two out"
        )
    training: list[Samples] = [stream(streams, seed=seed)]
    if datasets:
        if any(weight is not None for _, weight in datasets):
            raise click.UsageError(
                "with --stream, datasets validate, and have no weights; give those of --stream"
            )
        return training, opened(find_datasets(names, show_progress=verbose), "val")
    return training, [stream(streams, seed=seed, split="val", samples=count or VAL_MAPS)]


def _take_settings(weights: str, options: dict[str, Any]) -> None:
    """Add the settings of the network called `weights` to `options`. Its loss, if the file records
    it, replaces the defaults of options of the loss. Options of a network must not be given."""
    from scenegen.model.checkpoint import check_own
    from scenegen.model.completion.completer import open_network

    if conflicts := [name for name in fields_in(NetworkConfig, options) if was_given(name)]:
        raise click.UsageError(
            f"--weights brings its network; leave out what else says of one: {', '.join(conflicts)}"
        )
    network, _, metadata = open_network(weights)
    try:
        known_terms = fields_in(
            LossConfig, metadata["settings"]["loss"]
        )  # other versions may have others
        loss = vars(LossConfig(**known_terms))
    except (KeyError, TypeError, ValueError):  # written by another program, without a loss
        loss = {}
    loss = {
        name: value for name, value in loss.items() if name not in options or not was_given(name)
    }
    trusted, plain = split_own(weights)
    # a stranger's file may name code as its loss, which would be imported
    check_own(plain, trusted, loss.get("objective", ""))
    options |= vars(network.config) | loss


class _Display:
    """Progress of a run: the mean loss of the last steps, rate, time left, and a line per epoch."""

    def __init__(self, variant: str, progress: ProgressBar, verbose: bool):
        self._variant, self._progress, self._talk = variant, progress, verbose
        self._recent, self._iou, self.begun = 0.0, "", False

    def on_start(self, epoch: int, total: int, finished: int) -> None:
        """Begin a bar.

        Args:
            epoch: Number of the epoch, from 0.
            total: Number of its maps.
            finished: Number of maps that are done already.
        """
        self.begun = True
        self._progress.restart(f"{self._variant}, epoch {epoch + 1}", total, finished)

    def on_step(self, maps: int, loss: float) -> None:
        """Count a step.

        Args:
            maps: Number of its maps.
            loss: Its loss.
        """
        # an exponential mean over about fifty steps
        self._recent = loss if self._recent == 0.0 else 0.98 * self._recent + 0.02 * loss
        self._progress.count(maps)
        self._progress.info(f"loss {self._recent:.4f}{self._iou}")

    def on_epoch(self, row: "Scalars") -> None:
        """Print the figures of an epoch."""
        self._iou = f", validation {_ious(row)}"
        if self._talk:
            loss, seconds = row["train_loss"], row["seconds"]
            echo(f"epoch {row['epoch']:.0f}: loss {loss:.4f}, {_validated(row)}, {seconds:.0f} s")


def _validated(row: "Scalars") -> str:
    near = f"Near-MAE {row['val_near_mae']:.3f} m"
    return f"validation loss {row['val_loss']:.4f}, {_ious(row)}, {near}"


def _ious(row: "Scalars") -> str:
    """IoU at the paper's threshold, and at the best one."""
    text = f"IoU {row['val_iou']:.3f} at the paper's threshold"
    for name, unit in UNITS.items():
        if (best := row.get(f"val_best_{name}")) is not None:
            paper = getattr(Thresholds(), name)
            text += f" {paper:g}{unit}, {row['val_best_iou']:.3f} at the best, {best:g}{unit}"
    return text
