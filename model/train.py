"""Train a completion network: one plain loop, seeded, that can be interrupted anywhere and goes on."""

import dataclasses
import math
import os
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from model.bench.reconstruction import METRICS, ReconstructionConfig, measure
from model.complete import Prediction, Thresholds
from model.data import Maps, TudfOf, epoch_batches, load
from model.losses import LossConfig, objective
from model.network import Network, NetworkConfig, Output
from model.provenance import commit, versions
from model.runfolder import Progress, RunFolder
from scenegen.errors import DatasetError, ScenegenError, StoppedError

SAVE_EVERY_S = 60.0
"""How much work a kill may cost, seconds."""


class TrainingError(ScenegenError):
    """Training cannot go on."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """All that a run's outcome depends on besides its datasets. "Paper" is the paper's section "Implementation
    Details"; "ours" is what it leaves open."""

    network: NetworkConfig = field(default_factory=NetworkConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    epochs: int = 100
    """At most; the learning rate falls to 0 by the last (ours)."""
    batch: int = 8
    """Maps a step, over all devices (ours)."""
    lr: float = 1e-3
    """Of AdamW, after the warm-up; then down a cosine (ours)."""
    warmup_share: float = 0.02
    """Share of all steps over which the learning rate rises from 0 (ours)."""
    weight_decay: float = 0.01
    """Of AdamW (ours)."""
    clip: float = 1.0
    """Largest norm of a step's gradient (ours)."""
    patience: int = 10
    """Epochs without a lower validation loss after which training ends (paper)."""
    augment: bool = False
    """Whether maps are turned and mirrored about the sensor at random (ours)."""
    seed: int = 0
    """Of the first weights and the order of samples."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """Of the network's arithmetic; losses and weights are float32. Auto: bfloat16 where the device has instructions for
    it."""
    compile: bool = False
    """Whether to run the network through torch.compile: slower on CPUs (docs/log.md)."""

    def __post_init__(self) -> None:
        for name in ("epochs", "batch", "patience"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} = {getattr(self, name)} must be at least 1")
        for name in ("lr", "clip"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} = {getattr(self, name)} must be finite and above 0")
        if not 0 <= self.warmup_share < 1 or not 0 <= self.weight_decay < math.inf:
            raise ValueError("warmup_share must lie in [0, 1), and weight_decay be finite and at least 0")


@dataclass(frozen=True, kw_only=True)
class Watcher:
    """Who is told how a run goes, and may end it."""

    on_start: Callable[[int, int], None] = lambda total, done: None
    """Called with the steps of an epoch and those done, at the begin of every epoch."""
    on_step: Callable[[int, float], None] = lambda maps, loss: None
    """Called with the maps and the loss of every step."""
    on_epoch: Callable[[dict[str, float]], None] = lambda row: None
    """Called with the figures of every finished epoch."""
    stop: Callable[[], bool] = lambda: False
    """Whether to stop, state saved."""


def train(
    folders: Sequence[Path],
    config: TrainConfig,
    out: Path,
    *,
    device: str = "auto",
    workers: int = 0,
    resume: bool = False,
    command: str = "",
    watcher: Watcher | None = None,
) -> list[dict[str, float]]:
    """Train on the train splits of `folders`, validate on their val splits, keep the best network in `out`.

    Under ``torchrun`` every process takes its part of each batch. Returns the figures of every epoch. Raises
    DatasetError, CheckpointError, TrainingError, and StoppedError when `watcher` asks to stop; whatever is raised, the
    last good state stays in `out`.
    """
    watcher = watcher or Watcher()
    where, group = choose_device(device), _Group()
    with group:
        maps, checks = Maps(folders, "train"), Maps(folders, "val")
        check_maps(maps, checks, config, group.size)
        precision = resolve_precision(config.precision, where)
        torch.manual_seed(config.seed)
        network = Network(config.network).to(where, memory_format=torch.channels_last_3d)
        optimizer = torch.optim.AdamW(network.parameters(), lr=config.lr, weight_decay=config.weight_decay)
        settings = describe(maps, config, precision)
        about = {"command": command, "commit": commit(), "versions": versions(), "device": _device_name(where)}
        folder = RunFolder(out)
        if group.first:
            folder.open({"settings": settings, **about}, resume=resume)
        group.wait()
        restored = folder.restore()
        progress = Progress()
        if restored is not None:
            progress, tensors = restored
            put_state(network, optimizer, tensors)
        step = _Step(network, optimizer, config, maps, where, precision, group)
        per_epoch = len(epoch_batches(maps, batch=config.batch, seed=config.seed, epoch=0))
        saved = time.monotonic()
        while progress.epoch < config.epochs and progress.epoch - progress.best_epoch <= config.patience:
            begin = time.monotonic() - progress.seconds
            watcher.on_start(per_epoch, progress.step)
            network.train()
            batches = epoch_batches(
                maps, batch=config.batch, seed=config.seed, epoch=progress.epoch, augment=config.augment
            )[progress.step :]
            parts = [batch[group.rank :: group.size] for batch in batches]
            for batch, loaded in zip(
                batches, load(maps, parts, workers=workers, pinned=where.type == "cuda"), strict=True
            ):
                done = progress.epoch * per_epoch + progress.step
                rate = learning_rate(config, done, config.epochs * per_epoch)
                losses = step(*loaded, rate, lambda batch=batch: _named(maps, batch, progress))
                for name, value in losses.items():
                    progress.sums[name] = progress.sums.get(name, 0.0) + value
                progress.step += 1
                progress.seconds = time.monotonic() - begin
                watcher.on_step(len(batch), losses["loss"])
                stop = group.any(watcher.stop())
                if group.first and (stop or time.monotonic() - saved > SAVE_EVERY_S):
                    folder.save(progress, get_state(network, optimizer))
                    saved = time.monotonic()
                if stop:
                    raise StoppedError(f"stopped; {out} goes on where it was with --resume")
            figures = {f"train_{name}": value / per_epoch for name, value in progress.sums.items()}
            figures |= {
                f"val_{name}": value
                for name, value in validate(network, checks, config, where, precision, group, workers).items()
            }
            row = {"epoch": progress.epoch + 1.0, "lr": rate, **figures, "seconds": time.monotonic() - begin}
            progress.rows.append(row)
            if row["val_loss"] < progress.best_loss:
                progress.best_loss, progress.best_epoch = row["val_loss"], progress.epoch
                if group.first:
                    folder.save_best(network, maps.grid, {**about, "settings": settings, "figures": row})
            progress.epoch, progress.step, progress.sums, progress.seconds = progress.epoch + 1, 0, {}, 0.0
            if group.first:
                folder.write_rows(progress.rows)
                folder.save(progress, get_state(network, optimizer))
                saved = time.monotonic()
            watcher.on_epoch(row)
        return progress.rows


class _Step:
    """One optimiser step: loss, gradient, update."""

    def __init__(
        self,
        network: Network,
        optimizer: torch.optim.Optimizer,
        config: TrainConfig,
        maps: Maps,
        device: torch.device,
        precision: torch.dtype,
        group: "_Group",
    ):
        self._parameters = list(network.parameters())
        self._optimizer, self._config, self._device, self._group = optimizer, config, device, group
        self._grid, self._tudf_of = maps.grid, TudfOf(maps.grid)
        self._autocast = lambda: autocast(device, precision)
        model: nn.Module = network
        if group.size > 1:
            if device.type == "cuda":
                model = nn.SyncBatchNorm.convert_sync_batchnorm(model)
            model = DistributedDataParallel(model)
        self._model = torch.compile(model) if config.compile else model

    def __call__(
        self, observed: Tensor, occupancy: Tensor, rate: float, name_batch: Callable[[], str]
    ) -> dict[str, float]:
        """The losses of a batch, after learning from it. Raises TrainingError where they are not finite."""
        for parameters in self._optimizer.param_groups:
            parameters["lr"] = rate
        try:
            losses = self._learn(observed, occupancy)
        except (torch.OutOfMemoryError, RuntimeError) as error:
            if not isinstance(error, torch.OutOfMemoryError) and "not enough memory" not in str(error):
                raise
            self._optimizer.zero_grad(set_to_none=True)
            raise TrainingError(self._too_large(observed, occupancy)) from None
        if self._group.any(not all(map(math.isfinite, losses.values()))):
            found = ", ".join(f"{name} {value:.4g}" for name, value in losses.items())
            raise TrainingError(f"training diverged at {name_batch()}: {found}; lower --lr, or look at these samples")
        return losses

    def _learn(self, observed: Tensor, occupancy: Tensor) -> dict[str, float]:
        observed = observed.to(self._device, non_blocking=True).float()
        occupancy = occupancy.to(self._device, non_blocking=True)
        self._optimizer.zero_grad(set_to_none=True)
        with self._autocast():
            output = Output(*self._model(observed))
        losses = objective(
            output,
            occupancy,
            self._tudf_of(occupancy),
            self._config.loss,
            voxel_m=self._grid.voxel_m,
            truncation_m=self._grid.truncation_m,
        )
        losses["loss"].backward()
        norm = nn.utils.clip_grad_norm_(self._parameters, self._config.clip)
        if torch.isfinite(norm):  # otherwise the weights stay as they were, and the caller sees why
            self._optimizer.step()
        return {**{name: value.item() for name, value in losses.items()}, "gradient": norm.item()}

    def _too_large(self, observed: Tensor, occupancy: Tensor) -> str:
        """Which batch would fit, found by trying."""
        there = len(observed)
        fits = there // 2
        while fits:
            try:
                if self._device.type == "cuda":
                    torch.cuda.empty_cache()
                self._learn(observed[:fits], occupancy[:fits])
                break
            except (torch.OutOfMemoryError, RuntimeError):
                fits //= 2
        whole = f"out of memory: a batch of {there * self._group.size} does not fit"
        return f"{whole}; give --batch {fits * self._group.size}, which does" if fits else f"{whole}, nor does one map"


@torch.inference_mode()
def validate(
    network: Network,
    maps: Maps,
    config: TrainConfig,
    device: torch.device,
    precision: torch.dtype,
    group: "_Group",
    workers: int = 0,
) -> dict[str, float]:
    """Mean over samples of the losses and of the bench's metrics at the paper's thresholds; and ``largest``, the
    largest probability anywhere: below the threshold, nothing can be occupied."""
    network.eval()
    tudf_of, thresholds = TudfOf(maps.grid), Thresholds()
    batches = [list(range(n, min(n + config.batch, len(maps)))) for n in range(0, len(maps), config.batch)]
    sums: dict[str, float] = {}
    largest = 0.0
    for observed, occupancy in load(maps, batches[group.rank :: group.size], workers=workers, pinned=False):
        tudf = tudf_of(occupancy.to(device))
        with autocast(device, precision):
            output = network(observed.to(device).float())
        grid = maps.grid
        losses = objective(
            output, occupancy.to(device), tudf, config.loss, voxel_m=grid.voxel_m, truncation_m=grid.truncation_m
        )
        found = {name: value.item() * len(observed) for name, value in losses.items()}
        probability = None if output.logits is None else output.logits.float().sigmoid().cpu().numpy()
        distance = None if output.tudf is None else output.tudf.float().cpu().numpy()
        for n, (truth, field_m) in enumerate(zip(occupancy.numpy(), tudf.cpu().numpy(), strict=True)):
            said = Prediction(
                occupancy_probability=None if probability is None else probability[n],
                tudf=None if distance is None else distance[n],
            )
            measured = measure(
                said.occupied(thresholds),
                said.distance(thresholds, grid),
                truth,
                field_m,
                classes=np.zeros(grid.shape, np.uint8),
                class_count=1,
                config=ReconstructionConfig(),
            )[0]
            for name, value in zip(METRICS, np.nan_to_num(measured).tolist(), strict=True):
                found[name] = found.get(name, 0.0) + value
        for name, value in found.items():
            sums[name] = sums.get(name, 0.0) + value
        if probability is not None:
            largest = max(largest, float(probability.max()))
    sums = group.sum(sums)
    return {name: value / len(maps) for name, value in sums.items()} | {"largest": group.max(largest)}


def learning_rate(config: TrainConfig, step: int, steps: int) -> float:
    """Of step `step` of `steps`: up a line, then down a cosine to 0."""
    warmup = math.ceil(config.warmup_share * steps)
    if step < warmup:
        return config.lr * (step + 1) / warmup
    return config.lr * 0.5 * (1 + math.cos(math.pi * (step - warmup) / (steps - warmup)))


def choose_device(name: str) -> torch.device:
    """The device called `name`; ``auto`` is a GPU where there is one, this process's own under torchrun.

    Raises TrainingError for a device that is not here.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
        if device.type == "cuda" and device.index is None:
            device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0)))
        torch.zeros(1, device=device)
        if device.type == "cuda":
            torch.cuda.set_device(device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise TrainingError(
            f"--device {name}: cannot be used here ({reason}); give cpu, or cuda where there is one"
        ) from None
    return device


def resolve_precision(precision: str, device: torch.device) -> torch.dtype:
    """The type that `precision` means on `device`."""
    if precision != "auto":
        return torch.bfloat16 if precision == "bfloat16" else torch.float32
    if device.type == "cuda":
        return torch.bfloat16 if torch.cuda.is_bf16_supported(including_emulation=False) else torch.float32
    native = device.type == "cpu" and getattr(torch.cpu, "_is_avx512_bf16_supported", lambda: False)()
    return torch.bfloat16 if native else torch.float32


def autocast(device: torch.device, precision: torch.dtype) -> Any:
    """Where the network computes in `precision`."""
    return nullcontext() if precision == torch.float32 else torch.autocast(device.type, dtype=precision)


def check_maps(maps: Maps, checks: Maps, config: TrainConfig, processes: int) -> None:
    """Raise DatasetError or TrainingError where these splits cannot be trained on."""
    stride = config.network.stride
    for split in (maps, checks):
        if not len(split):
            raise DatasetError(
                f"{', '.join(str(dataset.folder) for dataset in split.datasets)}: the {split.split} split is empty; "
                f"generate some samples with {'--n' if split.split == 'train' else '--' + split.split}"
            )
    if any(edge % stride for edge in maps.grid.shape):
        raise DatasetError(
            f"{maps.datasets[0].folder}: its maps are {maps.grid.shape} voxels; the network halves them three "
            f"times, so every edge must be a multiple of {stride}"
        )
    if config.batch % processes:
        raise TrainingError(f"--batch {config.batch} does not divide among {processes} processes; give a multiple")


def describe(maps: Maps, config: TrainConfig, precision: torch.dtype) -> dict[str, Any]:
    """What decides a run: a run with another description is another run."""
    return {
        "datasets": [str(dataset.manifest["digest"]) for dataset in maps.datasets],
        "kinds": [str(dataset.manifest["kind"]) for dataset in maps.datasets],
        "samples": len(maps),
        **dataclasses.asdict(config),
        "precision": str(precision).removeprefix("torch."),
    }


def get_state(network: Network, optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Weights and the optimiser's moments, by name."""
    tensors = {f"network/{name}": tensor for name, tensor in network.state_dict().items()}
    for name, parameter in network.named_parameters():
        for key, value in optimizer.state.get(parameter, {}).items():
            tensors[f"optimizer/{name}/{key}"] = value
    return tensors


def put_state(network: Network, optimizer: torch.optim.Optimizer, tensors: dict[str, Tensor]) -> None:
    """Undo `get_state`."""
    prefix = "network/"
    network.load_state_dict({name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)})
    for name, parameter in network.named_parameters():
        prefix = f"optimizer/{name}/"
        found = {key[len(prefix) :]: value for key, value in tensors.items() if key.startswith(prefix)}
        if found:
            optimizer.state[parameter] = {
                key: value if key == "step" else value.to(parameter.device).clone(memory_format=torch.preserve_format)
                for key, value in found.items()
            }


def _named(maps: Maps, batch: list[tuple[int, int]], progress: Progress) -> str:
    names = "; ".join(maps.name(index) for index, _ in batch)
    return f"epoch {progress.epoch + 1}, step {progress.step + 1} (samples {names})"


def _device_name(device: torch.device) -> str:
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"{device.type}, {torch.get_num_threads()} threads"


class _Group:
    """The processes of a torchrun, or this one alone."""

    def __init__(self) -> None:
        self.size = int(os.environ.get("WORLD_SIZE", 1))
        self.rank = int(os.environ.get("RANK", 0))

    @property
    def first(self) -> bool:
        """Whether this process writes files."""
        return self.rank == 0

    def __enter__(self) -> "_Group":
        if self.size > 1:
            dist.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
        return self

    def __exit__(self, *error: object) -> None:
        if self.size > 1:
            dist.destroy_process_group()

    def wait(self) -> None:
        """Until all are here."""
        if self.size > 1:
            dist.barrier()

    def any(self, mine: bool) -> bool:
        """Whether any process says so."""
        return self.max(float(mine)) > 0

    def max(self, mine: float) -> float:
        """The largest of all processes' numbers."""
        return self._reduce([mine], dist.ReduceOp.MAX)[0]

    def sum(self, mine: dict[str, float]) -> dict[str, float]:
        """All processes' numbers added up, by name."""
        return dict(zip(mine, self._reduce(list(mine.values()), dist.ReduceOp.SUM), strict=True))

    def _reduce(self, values: list[float], how: Any) -> list[float]:
        if self.size == 1:
            return values
        device = "cuda" if torch.cuda.is_available() else "cpu"
        tensor = torch.tensor(values, dtype=torch.float64, device=device)
        dist.all_reduce(tensor, how)
        return [float(value) for value in tensor.tolist()]
