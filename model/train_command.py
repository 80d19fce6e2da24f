"""What `scenegen train` does: options become a configuration, and the run is reported."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

from scenegen.model.config import LossConfig, NetworkConfig, TrainConfig
from scenegen.model.training.data import opened
from scenegen.model.training.device import TrainingError, choose_device
from scenegen.model.training.loop import Watcher, train
from scenegen.workers import cores


class Progress(Protocol):
    """Shows how far an epoch has come."""

    def restart(self, label: str, total: int, done: int) -> None:
        """An epoch of `total` maps begins, `done` of them are done."""

    def count(self, samples: int) -> None:
        """So many more are done."""

    def note(self, text: str) -> None:
        """Show `text`."""


def run_train(
    folders: Sequence[Path],
    *,
    variant: Any,
    out: Path,
    options: dict[str, Any],
    command: str,
    progress: Progress,
    say: Callable[[str], None],
    stop: Callable[[], bool],
) -> None:
    """Train, showing the loss of the last steps, the rate, the time left, and a line an epoch.

    Raises TrainingError for options that no run can have; for the rest see `scenegen.model.training.loop.train`.
    """
    try:
        config = TrainConfig(
            network=NetworkConfig(variant=variant, width=options["width"], stem_stride=int(options["stem_stride"])),  # type: ignore[arg-type]
            loss=LossConfig(beta_m=options["beta_m"]),
            **{
                name: options[name]
                for name in ("epochs", "batch", "lr", "patience", "seed", "augment", "precision", "compile")
            },
        )
    except ValueError as error:
        raise TrainingError(str(error)) from None
    device = choose_device(options["device"])
    workers = options["workers"]
    if workers is None:
        workers = 0 if device.type == "cpu" else min(8, cores())
    recent, iou, begun = 0.0, "", False

    def on_start(epoch: int, total: int, done: int) -> None:
        nonlocal begun
        begun = True
        progress.restart(f"{variant}, epoch {epoch + 1} of {config.epochs}", total, done)

    def on_step(maps: int, loss: float) -> None:
        nonlocal recent
        recent = loss if recent == 0.0 else 0.98 * recent + 0.02 * loss
        progress.count(maps)
        progress.note(f"loss {recent:.4f}{iou}")

    def on_epoch(row: dict[str, float]) -> None:
        nonlocal iou
        iou = f", validation IoU {row['val_iou']:.3f}"
        say(
            f"epoch {row['epoch']:.0f}: loss {row['train_loss']:.4f}, validation loss {row['val_loss']:.4f}, "
            f"IoU {row['val_iou']:.3f}, Near-MAE {row['val_near_mae']:.3f} m, {row['seconds']:.0f} s"
        )

    begin = time.monotonic()
    rows = train(
        opened(folders, "train"),
        opened(folders, "val"),
        config,
        out,
        device=str(device),
        workers=workers,
        command=command,
        watcher=Watcher(on_start=on_start, on_step=on_step, on_epoch=on_epoch, stop=stop),
    )
    best = min(rows, key=lambda row: row["val_loss"])
    if not begun:
        say(f"{out}: this run is complete already; give another --out for another one")
    say(
        f"best: epoch {best['epoch']:.0f} of {len(rows)}, validation loss {best['val_loss']:.4f}, "
        f"IoU {best['val_iou']:.3f}, Near-MAE {best['val_near_mae']:.3f} m; {out}, {time.monotonic() - begin:.0f} s"
    )
