"""A training run on disk: its settings, its figures, its best network, and all that is needed to go on."""

import csv
import dataclasses
import fcntl
import io
import json
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import IO, Any

import torch
from torch import Tensor

from lidarsim import GridSpec
from scenegen.dataset.manifest import differences
from scenegen.errors import DatasetError, printable, short
from scenegen.files import disk_error, read_bounded, remove_drafts, write_whole
from scenegen.limits import MOST_HEADER_BYTES
from scenegen.model.checkpoint import CheckpointError, load_tensors, save_network, save_tensors
from scenegen.model.config import PROTOCOLS, LossConfig, NetworkConfig
from scenegen.model.evaluation.metrics import METRICS
from scenegen.model.network import Network
from scenegen.model.training.card import card
from scenegen.model.training.curve import draw

CONFIG, ROWS, CURVE, CARD = "config.json", "metrics.csv", "curve.png", "card.md"
FIGURES = frozenset({"val_loss"} | {f"val_{name}" for name, metric in METRICS.items() if metric.paper})
"""What every epoch's row holds, whichever version wrote it."""
BEST, LAST, LEVEL = "best.safetensors", "last.safetensors", "level.safetensors"
BUDGETS = ("epochs", "maps")
"""Settings that may grow while all others stay."""
EARLIER = PROTOCOLS["paper"] | {"maps": None, "interval": None, "decay_share": 0.2, "choose": "loss"}
"""What runs of earlier commits, whose settings lack these names, did."""


@dataclass
class Progress:
    """How far a run has come; with the weights and the optimiser's moments, all that the rest of it depends on."""

    epoch: int = 0
    """Epochs that are finished."""
    step: int = 0
    """Steps of the next epoch that are done."""
    best_epoch: int = -1
    """The epoch of the best validation loss; -1 for none yet."""
    best_loss: float = float("inf")
    decay: int | None = None
    """The step at which validation stalled and the learning rate began to fall; None while it has not."""
    sums: dict[str, float] = field(default_factory=dict)
    """Each loss, summed over the epoch's steps so far."""
    seconds: float = 0.0
    """How long the epoch has taken so far."""
    rows: list[dict[str, float]] = field(default_factory=list)
    """One a finished epoch: see docs/training.md."""

    def check(self) -> None:
        """Raise TypeError or ValueError where this is none that a run can have."""
        for name, least in (("epoch", 0), ("step", 0), ("best_epoch", -1)):
            value = getattr(self, name)
            if not isinstance(value, int) or not least <= value:
                raise ValueError(f"{name} = {short(value)}")
        if self.decay is not None and not isinstance(self.decay, int):
            raise TypeError(f"decay = {short(self.decay)}")
        figures = [self.sums, *self.rows]
        if len(self.rows) != self.epoch or not all(isinstance(row, dict) for row in figures):
            raise ValueError(f"{len(self.rows)} rows of {self.epoch} epochs")
        numbers = [self.best_loss, self.seconds, *(value for row in figures for value in row.values())]
        if not all(isinstance(value, int | float) for value in numbers):
            raise TypeError("figures that are no numbers")
        if any(missing := FIGURES - row.keys() for row in self.rows):
            raise ValueError(f"rows without {', '.join(missing)}")

    def add(self, losses: dict[str, float]) -> None:
        """Count a step."""
        self.step += 1
        self.sums = {name: self.sums.get(name, 0.0) + value for name, value in losses.items()}

    def close(self, validated: dict[str, float], *, maps: int, seconds: float) -> dict[str, float]:
        """Count a round after which the run has seen `maps` maps, and give its row."""
        row = {"epoch": self.epoch + 1.0, "maps": float(maps), "seconds": seconds}
        row |= {f"train_{name}": value / self.step for name, value in self.sums.items()}
        row |= {f"val_{name}": value for name, value in validated.items()}
        self.rows.append(row)
        if row["val_loss"] < self.best_loss:
            self.best_loss, self.best_epoch = row["val_loss"], self.epoch
        self.epoch, self.step, self.sums, self.seconds = self.epoch + 1, 0, {}, 0.0
        return row


def kept(rows: list[dict[str, float]], choose: str) -> dict[str, float]:
    """The row of the network that a run keeps: `choose` as in `TrainConfig`."""
    return rows[-1] if choose == "last" else min(rows, key=lambda row: row[f"val_{choose}"])


class RunFolder:
    """The folder of one run. Files in it are whole or absent, and the last good ones outlive any failure."""

    def __init__(self, path: Path):
        self.path = path
        self._lock: IO[str] | None = None

    def open(self, settings: dict[str, Any]) -> None:
        """Begin a run with `settings`, or go on with the one that was begun with them, or with a smaller budget: where
        its learning rate had begun to fall, it goes on from there, and its best network is kept under another name.

        Raises DatasetError where the folder holds a run with other settings, or one that another process works on.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise disk_error(self.path, error) from None
        remove_drafts(self.path)
        config = self.path / CONFIG
        if config.exists():
            there, asked = self.settings(), json.loads(json.dumps(settings["settings"]))
            if grows := _grows(there, asked):
                there |= {name: asked[name] for name in BUDGETS}
            if unlike := differences(there, asked):
                raise DatasetError(
                    f"{self.path}: was begun with other settings ({printable('; '.join(unlike))[:1000]}); give those, "
                    "or another --out"
                )
            if grows:
                self._grow()
                write_whole(config, (json.dumps(settings, indent=1) + "\n").encode())
        elif (self.path / LAST).exists():
            raise DatasetError(f"{self.path}: holds {LAST} but no {CONFIG}; choose another --out")
        else:
            write_whole(config, (json.dumps(settings, indent=1) + "\n").encode())
        self._lock = open(config)  # noqa: SIM115 (held until `close`)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise DatasetError(f"{self.path}: another process trains this run; wait, or give another --out") from None
        except OSError:  # a file system without locks
            return

    def close(self) -> None:
        """Let other processes work on the run."""
        if self._lock is not None:
            self._lock.close()

    def settings(self) -> dict[str, Any]:
        """What the run was begun with. Raises DatasetError where there is none."""
        try:
            settings = dict(json.loads(read_bounded(self.path / CONFIG, MOST_HEADER_BYTES))["settings"])
            if isinstance(network := settings.get("network"), dict):  # runs of earlier commits name none of these
                network.setdefault("inputs", list(NetworkConfig().inputs))
                network.setdefault("height", NetworkConfig().height)
            if isinstance(loss := settings.get("loss"), dict):
                loss.setdefault("lovasz", LossConfig().lovasz)
            return EARLIER | settings
        except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
            raise DatasetError(
                f"{self.path / CONFIG}: cannot be read ({printable(error)[:200]}); choose another --out"
            ) from None

    def _grow(self) -> None:
        """Go back to where the learning rate began to fall, if it did."""
        if (self.path / LEVEL).exists():
            if (self.path / BEST).exists():
                (self.path / BEST).replace(self.path / f"{datetime.now():best-%Y-%m-%d-%H%M%S}.safetensors")
            (self.path / LEVEL).replace(self.path / LAST)

    def save(self, progress: Progress, network: Network, optimizer: torch.optim.Optimizer, name: str = LAST) -> None:
        """Write all that is needed to go on from here."""
        save_tensors(self.path / name, _state(network, optimizer), dataclasses.asdict(progress))

    def restore(self, network: Network, optimizer: torch.optim.Optimizer) -> Progress:
        """Bring back what `save` wrote last, if it did. Raises CheckpointError where it is damaged."""
        if not (self.path / LAST).exists():
            return Progress()
        try:
            tensors, header = load_tensors(self.path / LAST)
            progress = Progress(**header)
            progress.check()
            _set_state(network, optimizer, tensors)
            return progress
        except (CheckpointError, TypeError, ValueError, RuntimeError):
            raise CheckpointError(
                f"{self.path / LAST}: not the state of this run; remove it to begin again, {BEST} stays until then"
            ) from None

    def save_best(self, network: Network, grid: GridSpec, about: dict[str, Any]) -> None:
        """Write the best network so far, and its card."""
        save_network(self.path / BEST, network, grid, about)
        write_whole(self.path / CARD, card(self.path.name, about).encode())

    def write_rows(self, rows: list[dict[str, float]]) -> None:
        """Write the figures of all epochs."""
        text = io.StringIO()
        names = dict.fromkeys(name for row in rows for name in row)  # a later version may know more metrics
        writer = csv.DictWriter(text, list(names), lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: f"{value:.6g}" for name, value in row.items()} for row in rows)
        write_whole(self.path / ROWS, text.getvalue().encode())
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            return
        with SummaryWriter(str(self.path / "tensorboard")) as writer:
            for name, value in rows[-1].items():
                writer.add_scalar(name.replace("_", "/", 1), value, int(rows[-1]["epoch"]))

    def draw_rows(self, rows: list[dict[str, float]]) -> None:
        """Draw the figures that `write_rows` wrote, where matplotlib is installed and they are not drawn yet."""
        files = self.path / CURVE, self.path / ROWS
        drawn, written = (file.stat().st_mtime_ns if file.exists() else 0 for file in files)
        if drawn >= written:
            return
        picture = draw_curve(rows)
        if picture is not None:
            write_whole(self.path / CURVE, picture)


def draw_curve(rows: list[dict[str, float]]) -> bytes | None:
    """The curve of `scenegen.model.training.curve` as PNG; None where matplotlib is not installed."""
    try:
        figure = draw(rows)
    except ImportError:
        return None
    memory = io.BytesIO()
    figure.savefig(memory, format="png", dpi=100)
    return memory.getvalue()


def _grows(there: dict[str, Any], asked: dict[str, Any]) -> bool:
    """Whether `asked` is a larger budget of the settings `there`, of a run that can grow."""
    of = there["maps"], asked["maps"]
    old, new = (there["epochs"], asked["epochs"]) if of == (None, None) else of
    return asked["schedule"] == "decay" and None not in (old, new) and bool(new > old)


def _state(network: Network, optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Weights and the optimiser's moments, by name."""
    tensors = {f"network/{name}": tensor for name, tensor in network.state_dict().items()}
    for name, parameter in network.named_parameters():
        for key, value in optimizer.state.get(parameter, {}).items():
            tensors[f"optimizer/{name}/{key}"] = value
    return tensors


def _set_state(network: Network, optimizer: torch.optim.Optimizer, tensors: dict[str, Tensor]) -> None:
    """Undo `_state`."""
    prefix = "network/"
    network.load_state_dict({name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)})
    for name, parameter in network.named_parameters():
        prefix = f"optimizer/{name}/"
        for key, value in tensors.items():
            if key.startswith(prefix):  # a step count is a lone number; moments lie in memory as their weights do
                moment = torch.empty_like(parameter).copy_(value) if value.ndim else value
                optimizer.state[parameter][key[len(prefix) :]] = moment
