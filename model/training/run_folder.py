"""A training run on disk: its settings, its figures, its best network, and all that is needed to go
on."""

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
"""What a run writes, and replaces, in a folder with its `CONFIG`."""
SAVE_EVERY_S = 60.0
"""How much work a kill may cost, seconds."""


@dataclass
class Progress:
    """How far a run has come; with the weights and the optimiser's moments, all that the rest of it
    depends on."""

    step: int = 0
    """Steps of the next epoch that are done."""
    decay: int | None = None
    """The step at which validation stalled and the learning rate began to fall; None while it has
    not."""
    sums: Scalars = field(default_factory=dict)
    """Each loss, summed over the epoch's steps so far."""
    seconds: float = 0.0
    """How long the epoch has taken so far."""
    rows: list[Scalars] = field(default_factory=list)
    """One a finished epoch: see docs/training.md."""

    @property
    def epoch(self) -> int:
        """How many epochs are finished."""
        return len(self.rows)

    @property
    def waited(self) -> int:
        """How many epochs are finished since the one of the lowest validation loss."""
        losses = [row["val_loss"] for row in self.rows]
        return self.epoch - 1 - losses.index(min(losses)) if losses else 0

    def add(self, losses: Scalars, *, seconds: float) -> None:
        """Count a step, after which the round has taken so many `seconds`."""
        self.step, self.seconds = self.step + 1, seconds
        self.sums = {name: self.sums.get(name, 0.0) + value for name, value in losses.items()}

    def close(self, validated: Scalars, *, maps: int, seconds: float) -> Scalars:
        """Count a round after which the run has seen `maps` maps, and give its row."""
        row = {"epoch": self.epoch + 1.0, "maps": float(maps), "seconds": seconds}
        row |= {f"train_{name}": value / self.step for name, value in self.sums.items()}
        row |= {f"val_{name}": value for name, value in validated.items()}
        self.rows.append(row)
        self.step, self.sums, self.seconds = 0, {}, 0.0
        return row


class RunFolder:
    """The folder of one run. Files in it are whole or absent, and the last good ones outlive any
    failure.

    Of several processes that train together, one `writes`.
    """

    def __init__(self, path: Path, *, writes: bool = True):
        self.path, self._writes = path, writes
        self._lock: int | None = None
        self._saved = time.monotonic()
        self._learns: tuple[nn.Module, torch.optim.Optimizer]

    def open(self, settings: Json) -> None:
        """Begin a run with `settings`, or continue the one that was begun with them.

        Raises:
            DatasetError: if the folder holds a run with other settings, or one that another process
                works on.
        """
        with disk_errors(self.path):
            self.path.mkdir(parents=True, exist_ok=True)
            self._lock = os.open(self.path, os.O_RDONLY)  # held until `close`
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise DatasetError(
                f"{self.path}: another process trains this run; wait, or give another --out"
            ) from None
        except OSError:  # a file system without locks
            pass
        remove_temp_files(self.path)
        config = self.path / CONFIG
        if config.exists():
            if unlike := differences(self.settings(), plain(settings["settings"])):
                raise DatasetError(
                    f"{self.path}: was begun with other settings "
                    f"({printable('; '.join(unlike))[:1000]}); give those, or another --out"
                )
            return
        if odd := next((name for name in FILES if (self.path / name).exists()), None):
            raise DatasetError(f"{self.path}: holds {odd} but no {CONFIG}; choose another --out")
        write_atomic(config, (json.dumps(settings, indent=1) + "\n").encode())

    def close(self) -> None:
        """Let other processes work on the run."""
        if self._lock is not None:
            os.close(self._lock)

    def settings(self) -> Json:
        """What the run was begun with. Raises DatasetError where there is none."""
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
        """Write all that is needed to go on from here, of what `restore` was given."""
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
        """Save the state if it was last saved long ago."""
        if time.monotonic() - self._saved > SAVE_EVERY_S:
            self.save(progress)

    def close_round(
        self,
        progress: Progress,
        network: nn.Module,
        grid: GridSpec,
        about: Json,
        choose: str,
    ) -> None:
        """Write what a finished round leaves, and its network if it is the one to keep so far."""
        rows, by = progress.rows, f"val_{choose}"
        if choose == "last" or (best := self.best()) is None or rows[-1][by] < best[by]:
            header = {**about, "figures": rows[-1]}
            save_network(self.path / BEST, network, grid, header)
            write_atomic(self.path / CARD, card(self.path.name, header).encode())
        self.write_rows(rows)
        self.save(progress)

    def best(self) -> Scalars | None:
        """The figures of the network that the run keeps; None before there is one."""
        path = self.path / BEST
        return load_tensors(path)[1]["about"]["figures"] if path.exists() else None

    def restore(self, network: nn.Module, optimizer: torch.optim.Optimizer) -> Progress:
        """Bring back what `save` wrote last, if it did; it then saves these two. Raises
        CheckpointError where it is damaged."""
        self._learns = network, optimizer
        if not (self.path / LAST).exists():
            return Progress()
        try:
            tensors, header = load_tensors(self.path / LAST)
            weights = {}
            for place, value in tensors.items():
                kind, _, name = place.partition("/")
                if kind == "network":
                    weights[name] = value
                    continue
                name, _, key = name.rpartition("/")
                like = network.get_parameter(name)
                # a step count is a lone number; moments lie in memory as their weights do
                moment = value if key == "step" else torch.empty_like(like).copy_(value)
                optimizer.state[like][key] = moment
            network.load_state_dict(weights)
            return Progress(**header)
        except (CheckpointError, AttributeError, TypeError, ValueError, RuntimeError):
            raise CheckpointError(
                f"{self.path / LAST}: not the state of this run; remove it to begin again, {BEST} "
                f"stays until then"
            ) from None

    def write_rows(self, rows: list[Scalars]) -> None:
        """Write the figures of all epochs."""
        text = io.StringIO()
        names = dict.fromkeys(name for row in rows for name in row)  # they may grow on the way
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
        """Draw the figures that `write_rows` wrote, if matplotlib is installed and they are not
        drawn yet: `scenegen render` draws those of a run that has not ended."""
        files = self.path / CURVE, self.path / ROWS
        drawn, written = (file.stat().st_mtime_ns if file.exists() else 0 for file in files)
        if drawn < written and self._writes:
            with suppress(ImportError):
                from scenegen.view.panels import to_bytes

                write_atomic(self.path / CURVE, to_bytes(draw(rows), ".png"))


FACTS = (
    "epoch", "val_loss", "val_iou", "val_best_iou", "val_best_probability", "val_best_distance_m",
    "val_near_mae",
)  # fmt: skip
"""Figures of the best epoch that `run_facts` gives."""


def run_facts(folder: Path) -> Json:
    """A training run's folder: what was trained on what, and how far it came. Raises
    DatasetError."""
    run, rows = RunFolder(folder), read_rows(folder / ROWS)
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
