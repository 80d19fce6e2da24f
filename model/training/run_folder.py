"""Folder of a training run: its settings, its figures, its best network, and its state."""

import csv
import fcntl
import io
import json
import os
import time
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch
from torch import nn

from lidarsim import GridSpec
from scenegen.base.errors import DatasetError, printable
from scenegen.base.files import Json, disk_errors, remove_temp_files, write_atomic
from scenegen.base.limits import MAX_HEADER_BYTES
from scenegen.base.reading import read_bounded
from scenegen.dataset.parameters import differences, plain
from scenegen.model.checkpoint import (
    CheckpointError,
    current_settings,
    load_tensors,
    save_network,
    save_tensors,
)
from scenegen.model.training.card import Scalars, card, draw, read_rows

CONFIG, ROWS, CURVE, CARD = "config.json", "metrics.csv", "curve.png", "card.md"
BEST, LAST = "best.safetensors", "last.safetensors"
FILES = (ROWS, CURVE, CARD, BEST, LAST)
"""Files that a run writes and replaces, but only in a folder with its `CONFIG`."""
SAVE_EVERY_S = 60.0
"""Time between two saves of the state within a round, seconds: the work that a kill may cost."""


@dataclass
class Progress:
    """Progress of a run. A run continues from this, the weights, and the optimiser's state."""

    step: int = 0
    """Finished steps of the current epoch."""
    decay: int | None = None
    """The step at which validation stalled and the learning rate began to fall; None before."""
    sums: Scalars = field(default_factory=dict)
    """Sum of each loss over the epoch's finished steps."""
    seconds: float = 0.0
    """Duration of the epoch so far."""
    rows: list[Scalars] = field(default_factory=list)
    """Figures of each finished epoch; see docs/training.md."""

    @property
    def epoch(self) -> int:
        """Number of finished epochs, which is the number of the current one, from 0."""
        return len(self.rows)

    @property
    def waited(self) -> int:
        """Number of epochs since the one with the lowest validation loss."""
        losses = [row["val_loss"] for row in self.rows]
        return self.epoch - 1 - losses.index(min(losses)) if losses else 0

    def add(self, losses: Scalars, *, seconds: float) -> None:
        """Count a step.

        Args:
            losses: Its losses by name.
            seconds: Duration of the epoch, with this step.
        """
        self.step, self.seconds = self.step + 1, seconds
        self.sums = {name: self.sums.get(name, 0.0) + value for name, value in losses.items()}

    def close(self, validated: Scalars, *, maps: int, seconds: float) -> Scalars:
        """Count an epoch, and begin the next.

        Args:
            validated: Figures of the validation, by name.
            maps: Number of maps that the run has seen.
            seconds: Duration of the epoch, with validation.

        Returns:
            Figures of the epoch.
        """
        row = {"epoch": self.epoch + 1.0, "maps": float(maps), "seconds": seconds}
        row |= {f"train_{name}": value / self.step for name, value in self.sums.items()}
        row |= {f"val_{name}": value for name, value in validated.items()}
        self.rows.append(row)
        self.step, self.sums, self.seconds = 0, {}, 0.0
        return row


class RunFolder:
    """Folder of one run. Files are written atomically, so the last good ones survive any failure.

    Args:
        path: The folder.
        writes: Whether this process writes files. Of several that train together, one does.
    """

    def __init__(self, path: Path, *, writes: bool = True):
        self.path, self._writes = path, writes
        self._lock: int | None = None
        self._saved = time.monotonic()
        self._learns: tuple[nn.Module, torch.optim.Optimizer]

    def open(self, settings: Json) -> None:
        """Begin a run, or continue the one in the folder.

        Args:
            settings: Metadata of the run. Only its `settings` must be those of a run that is
                continued; command, commit and device may differ.

        Raises:
            DatasetError: if the folder holds a run with other settings or files without a run, if
                another process works on it, or if the disk refuses.
        """
        with disk_errors(self.path):
            self.path.mkdir(parents=True, exist_ok=True)
            # on the folder itself: a lock file could be left behind by a kill
            self._lock = os.open(self.path, os.O_RDONLY)  # held until `close`
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise DatasetError(
                f"{self.path}: another process trains this run; wait, or give another --out"
            ) from None
        except OSError:  # a file system without locks
            pass
        # with the lock, no other process can be writing them
        remove_temp_files(self.path)
        config = self.path / CONFIG
        if config.exists():
            if unlike := differences(self.settings(), plain(settings["settings"])):
                raise DatasetError(
                    f"{self.path}: was begun with other settings "
                    f"({printable('; '.join(unlike))[:1000]}); give those, or another --out"
                )
            return
        # never replace files that no run has written
        if odd := next((name for name in FILES if (self.path / name).exists()), None):
            raise DatasetError(f"{self.path}: holds {odd} but no {CONFIG}; choose another --out")
        write_atomic(config, (json.dumps(settings, indent=1) + "\n").encode())

    def close(self) -> None:
        """Release the lock, so that other processes can work on the run."""
        if self._lock is not None:
            os.close(self._lock)

    def settings(self) -> Json:
        """Read the settings of the run, updated to this version.

        Raises:
            DatasetError: if the folder holds no run, or its settings are damaged.
        """
        try:
            content = read_bounded(self.path / CONFIG, MAX_HEADER_BYTES)
            settings = dict(json.loads(content)["settings"])
            return settings | {"network": current_settings(settings["network"])}
        except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
            raise DatasetError(
                f"{self.path / CONFIG}: cannot be read ({printable(error)[:200]}); choose another "
                f"--out"
            ) from None

    def save(self, progress: Progress) -> None:
        """Write the state: progress, and network and optimiser that `restore` was called with."""
        if not self._writes:
            return
        network, optimizer = self._learns
        state = {f"network/{name}": tensor for name, tensor in network.state_dict().items()} | {
            f"optimizer/{name}/{key}": value
            for name, parameter in network.named_parameters()
            for key, value in optimizer.state.get(parameter, {}).items()
        }
        save_tensors(self.path / LAST, state, asdict(progress))
        self._saved = time.monotonic()

    def save_in_time(self, progress: Progress) -> None:
        """Save the state if `SAVE_EVERY_S` have passed since the last save."""
        if time.monotonic() - self._saved > SAVE_EVERY_S:
            self.save(progress)

    def close_round(
        self,
        progress: Progress,
        network: nn.Module,
        grid: GridSpec,
        metadata: Json,
        choose: str,
    ) -> None:
        """Write figures and state after a round, and its network with a card if it is the best.

        Args:
            progress: Progress of the run, with the round's figures.
            network: The network.
            grid: Grid of the maps.
            metadata: Metadata of the network, without figures.
            choose: `TrainConfig.choose`: a term of the loss, or "last".

        Raises:
            DatasetError: if the disk refuses.
        """
        rows, by = progress.rows, f"val_{choose}"
        # The state comes last: a kill before it repeats the round, with the same files as result.
        if choose == "last" or (best := self.best()) is None or rows[-1][by] < best[by]:
            header = {**metadata, "figures": rows[-1]}
            save_network(self.path / BEST, network, grid, header)
            write_atomic(self.path / CARD, card(self.path.name, header).encode())
        self.write_rows(rows)
        self.save(progress)

    def best(self) -> Scalars | None:
        """Read the figures of the best network; None before the first round has ended."""
        path = self.path / BEST
        return load_tensors(path)[1]["about"]["figures"] if path.exists() else None

    def restore(self, network: nn.Module, optimizer: torch.optim.Optimizer) -> Progress:
        """Read the last saved state, if there is one. `save` then saves this network and optimiser.

        Args:
            network: The network, which gets the saved weights.
            optimizer: Its optimiser, which gets the saved moments.

        Returns:
            Progress of the run; at its begin if nothing was saved.

        Raises:
            CheckpointError: if the state is damaged, or of another network.
        """
        self._learns = network, optimizer
        if not (self.path / LAST).exists():
            return Progress()
        try:
            tensors, header = load_tensors(self.path / LAST)
            weights = {}
            for key, value in tensors.items():
                kind, _, name = key.partition("/")
                if kind == "network":
                    weights[name] = value
                    continue
                name, _, entry = name.rpartition("/")
                parameter = network.get_parameter(name)
                # moments get the memory layout of their weights (see `placed`), in which the
                # undisturbed run has them; a step count is a scalar
                moment = value if entry == "step" else torch.empty_like(parameter).copy_(value)
                optimizer.state[parameter][entry] = moment
            network.load_state_dict(weights)
            return Progress(**header)
        except (CheckpointError, AttributeError, TypeError, ValueError, RuntimeError):
            raise CheckpointError(
                f"{self.path / LAST}: not the state of this run; remove it to begin again, {BEST} "
                f"stays until then"
            ) from None

    def write_rows(self, rows: list[Scalars]) -> None:
        """Write the figures of all epochs; also those of the last to TensorBoard, if installed."""
        text = io.StringIO()
        # columns may begin later, such as in a run that an earlier version began
        names = dict.fromkeys(name for row in rows for name in row)
        writer = csv.DictWriter(text, list(names), lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: f"{value:.6g}" for name, value in row.items()} for row in rows)
        write_atomic(self.path / ROWS, text.getvalue().encode())
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            return
        with SummaryWriter(str(self.path / "tensorboard")) as writer:
            for name, value in rows[-1].items():
                writer.add_scalar(name.replace("_", "/", 1), value, int(rows[-1]["epoch"]))

    def draw_rows(self, rows: list[Scalars]) -> None:
        """Draw the figures if they have changed since, and if matplotlib is installed."""
        files = self.path / CURVE, self.path / ROWS
        drawn, written = (file.stat().st_mtime_ns if file.exists() else 0 for file in files)
        if drawn < written and self._writes:
            with suppress(ImportError):
                from scenegen.view.stills import to_bytes

                write_atomic(self.path / CURVE, to_bytes(draw(rows), ".png"))


FACTS = (
    "epoch", "val_loss", "val_iou", "val_best_iou", "val_best_probability", "val_best_distance_m",
    "val_near_mae",
)  # fmt: skip
"""Figures of the best epoch in `run_facts`."""


def run_facts(folder: Path) -> Json:
    """Summarise a run: its network, its samples, and the figures of its best epoch.

    Args:
        folder: The run's folder.

    Returns:
        JSON.

    Raises:
        DatasetError: if the folder holds no run, or no finished epoch.
        CheckpointError: if its network is damaged.
    """
    run, rows = RunFolder(folder), read_rows(folder / ROWS)
    # a copied folder may lack the network
    settings, best = run.settings(), run.best() or min(rows, key=lambda row: row["val_loss"])
    network = settings["network"]
    return {
        "run": str(folder),
        "network": network["variant"],
        "inputs": network["inputs"],
        "kinds": settings["kinds"],
        "samples": settings["samples"],
        "epochs": len(rows),
        "best": {name: best[name] for name in FACTS if name in best},
    }
