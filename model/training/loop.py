"""Train a completion network: one plain loop, seeded, that can be interrupted anywhere and goes on."""

import dataclasses
import hashlib
import math
import platform
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.nn.parallel import DistributedDataParallel

from lidarsim import GridSpec
from scenegen.checkout import commit
from scenegen.dataset.manifest import differences, installed, mapping_entry, software
from scenegen.dataset.sensor import entry_of
from scenegen.errors import DatasetError, StoppedError, empty_split, is_out_of_memory
from scenegen.mapping import Mapper
from scenegen.model.checkpoint import CheckpointError, load_network
from scenegen.model.config import VARIANTS, TrainConfig
from scenegen.model.losses import objective
from scenegen.model.network import Network, Output
from scenegen.model.training.course import Course
from scenegen.model.training.data import Batch, LoaderError, Maps, Samples, TudfOf, check_alike, load
from scenegen.model.training.device import (
    Group,
    TrainingError,
    autocast,
    choose_device,
    device_name,
    resolve_precision,
)
from scenegen.model.training.run_folder import LEVEL, Progress, RunFolder, kept
from scenegen.model.training.validation import validate

PACKAGES = ("torch", "safetensors")
"""What a trained network depends on, besides what a dataset does."""
SAVE_EVERY_S = 60.0
"""How much work a kill may cost, seconds."""


@dataclass(frozen=True, kw_only=True)
class Watcher:
    """Who is told how a run goes, and may end it."""

    on_start: Callable[[int, int, int], None] = lambda epoch, total, done: None
    """Called when an epoch begins, with its number from 0, its maps, and how many of them are done."""
    on_step: Callable[[int, float], None] = lambda maps, loss: None
    """Called with the maps and the loss of every step."""
    on_epoch: Callable[[dict[str, float]], None] = lambda row: None
    """Called with the figures of every finished epoch."""
    stop: Callable[[], bool] = lambda: False
    """Whether to stop, state saved."""


def train(
    training: Sequence[Samples],
    checking: Sequence[Samples],
    config: TrainConfig,
    out: Path,
    *,
    device: str = "auto",
    workers: int = 0,
    command: str = "",
    watcher: Watcher | None = None,
    weights: Path | None = None,
) -> list[dict[str, float]]:
    """Train on the samples in `training`, validate on those in `checking`, keep the best network in `out`.

    A run with the same settings that `out` holds already goes on where it was; one that is finished stays as it is.
    The first weights are random, or those of the network in the file `weights`, which must be of `config.network`.
    Under ``torchrun`` every process takes its part of each batch. Returns the figures of every epoch. Raises
    DatasetError, CheckpointError, TrainingError, and StoppedError when `watcher` asks to stop; whatever is raised, the
    last good state stays in `out`.
    """
    watcher = watcher or Watcher()
    where = choose_device(device)
    group = Group(where)
    with group, closing(RunFolder(out)) as folder:
        maps = Maps(training, "train", config.network.inputs)
        checks = Maps(checking, "val", config.network.inputs)
        if VARIANTS[config.network.variant].columns:
            config = replace(config, network=replace(config.network, height=maps.grid.shape[2]))
        check_maps(maps, checks, config, group.size)
        precision = resolve_precision(config.precision, where, maps.grid.shape)
        torch.manual_seed(config.seed)
        network = Network(config.network).placed(where)
        settings = describe(maps, config, precision)
        if weights is not None:
            settings["weights"] = _begin_from(weights, network)
        optimizer = optimizer_of(network, config)
        versions = software() | {"python": platform.python_version()} | {name: installed(name) for name in PACKAGES}
        about = {"command": command, "commit": commit(), "versions": versions, "device": device_name(where)}
        about["lidar"] = entry_of(maps.sources[0].lidar)
        noises = sorted({noise for source in maps.sources for noise in getattr(source, "noises", ("",))})
        about |= {"noise": noises} if any(noises) else {}
        about |= mapping_entry(getattr(maps.sources[0], "mapping", Mapper()))
        group.first_alone(lambda: folder.open({"settings": settings, **about}))
        progress = folder.restore(network, optimizer)
        learn = Step(network, optimizer, config, maps.grid, where, precision, group)
        course = Course(maps, config)
        saved = drawn = time.monotonic()
        stopped = f"stopped; the same command goes on with {out}"
        while (first := progress.epoch * course.round) < (end := course.end(progress.decay)):
            stalled = progress.epoch - progress.best_epoch > config.patience
            if stalled and config.schedule == "cosine":
                break
            if stalled and progress.decay is None and first < course.latest_decay:
                progress.decay = first
                continue  # the end has changed
            begin = time.monotonic() - progress.seconds
            steps = min(course.round, end - first)
            watcher.on_start(progress.epoch, steps * course.batch, progress.step * course.batch)
            network.train()
            batches = course.batches(first + progress.step, steps - progress.step)
            mine = [batch[group.rank :: group.size] for batch in batches]
            loaded = load(maps, mine, workers=workers, pinned=where.type == "cuda")
            for batch in batches:
                if group.first and first + progress.step == course.latest_decay and progress.decay is None:
                    folder.save(progress, network, optimizer, LEVEL)  # a larger budget goes on from here
                try:
                    maps_read = next(loaded)
                except LoaderError:
                    if not watcher.stop():  # the signal to stop went to the loader's processes, too
                        raise
                    if group.first:
                        folder.save(progress, network, optimizer)
                    raise StoppedError(stopped) from None
                losses = learn(maps_read, course.rate(first + progress.step, progress.decay))
                if not all(map(math.isfinite, losses.values())):
                    raise TrainingError(_diverged(maps, batch, progress, losses))
                progress.add(losses)
                progress.seconds = time.monotonic() - begin
                watcher.on_step(len(batch), losses["loss"])
                stop = group.any(watcher.stop())
                if group.first and (stop or time.monotonic() - saved > SAVE_EVERY_S):
                    folder.save(progress, network, optimizer)
                    saved = time.monotonic()
                if stop:
                    raise StoppedError(stopped)
            group.share_statistics(network)
            found = validate(network, checks, config.loss, config.batch, where, precision, group, workers)
            if not math.isfinite(found["loss"]):
                raise TrainingError(f"epoch {progress.epoch + 1}: the validation loss is {found['loss']}; lower --lr")
            seen = (first + steps) * course.batch
            row = progress.close(found, maps=seen, seconds=time.monotonic() - begin)
            if group.first:
                if kept(progress.rows, config.choose) == row:
                    folder.save_best(network, maps.grid, {**about, "settings": settings, "figures": row})
                folder.write_rows(progress.rows)
                folder.save(progress, network, optimizer)
                if time.monotonic() - drawn > SAVE_EVERY_S:  # which takes as long as some maps
                    folder.draw_rows(progress.rows)
                    drawn = time.monotonic()
                saved = time.monotonic()
            watcher.on_epoch(row)
        if group.first:
            folder.draw_rows(progress.rows)
        return progress.rows


class Step:
    """One optimiser step: loss, gradient, update."""

    def __init__(
        self,
        network: Network,
        optimizer: torch.optim.Optimizer,
        config: TrainConfig,
        grid: GridSpec,
        device: torch.device,
        precision: torch.dtype,
        group: Group,
    ):
        self._parameters = list(network.parameters())
        self._optimizer, self._config, self._device, self._group = optimizer, config, device, group
        self._grid, self._tudf_of = grid, TudfOf(grid)
        self._autocast = lambda: autocast(device, precision)
        model: nn.Module = network
        if group.size > 1:
            if device.type == "cuda":
                model = nn.SyncBatchNorm.convert_sync_batchnorm(model)
            model = DistributedDataParallel(model)
        self._model = torch.compile(model) if config.compile else model

    def __call__(self, batch: Batch, rate: float) -> dict[str, float]:
        """The losses of a batch and the norm of their gradient, before learning from it: means over all processes.

        Raises TrainingError, which says what would fit, where memory runs out.
        """
        for parameters in self._optimizer.param_groups:
            parameters["lr"] = rate
        try:
            return self._group.mean(self._learn(batch))
        except (RuntimeError, MemoryError) as error:
            if not is_out_of_memory(error):
                raise
        raise TrainingError(self._too_large(batch))

    def _learn(self, batch: Batch) -> dict[str, float]:
        batch = {name: values.to(self._device, non_blocking=True) for name, values in batch.items()}
        occupancy = batch["occupancy"]
        self._optimizer.zero_grad(set_to_none=True)
        with self._autocast():
            output = Output(*self._model(batch))
        losses = objective(
            output,
            occupancy,
            self._tudf_of(occupancy),
            self._config.loss,
            voxel_m=self._grid.voxel_m,
            truncation_m=self._grid.truncation_m,
            divisor=self._group.divisor,
        )
        losses["loss"].backward()
        norm = nn.utils.clip_grad_norm_(self._parameters, self._config.clip)
        if torch.isfinite(norm):  # otherwise the weights stay as they were, and the caller sees why
            self._optimizer.step()
        return {**{name: value.item() for name, value in losses.items()}, "gradient": norm.item()}

    def _too_large(self, batch: Batch) -> str:
        """Which batch would fit, found by trying."""
        processes, maps = self._group.size, len(batch["occupancy"])
        said = f"out of memory: a batch of {maps * processes} does not fit"
        if processes > 1:  # trying would wait for the others, who are not trying
            return f"{said}; give a smaller --batch"
        fits = maps // 2
        while fits:
            try:
                self._optimizer.zero_grad(set_to_none=True)
                if self._device.type == "cuda":
                    torch.cuda.empty_cache()
                self._learn({name: values[:fits] for name, values in batch.items()})
                return f"{said}; --batch {fits * processes} does"
            except (RuntimeError, MemoryError):
                fits //= 2
        return f"{said}, nor does one map: use a machine with more memory, or a smaller grid"


def optimizer_of(network: Network, config: TrainConfig) -> torch.optim.Optimizer:
    """AdamW; weight decay is for what multiplies features, and for vectors only where the configuration says so."""
    shrunk = [p for p in network.parameters() if config.decay_all or p.ndim > 1]
    others = [p for p in network.parameters() if not (config.decay_all or p.ndim > 1)]
    groups = [{"params": shrunk, "weight_decay": config.weight_decay}, {"params": others, "weight_decay": 0.0}]
    return torch.optim.AdamW([group for group in groups if group["params"]], lr=config.lr)


def check_maps(maps: Maps, checks: Maps, config: TrainConfig, processes: int) -> None:
    """Raise DatasetError or TrainingError where these splits cannot be trained on."""
    for split in (maps, checks):
        if not len(split):
            names = ", ".join(source.name for source in split.sources)
            raise DatasetError(f"{names}: {empty_split(split.split)}")
    try:
        config.network.check_map(maps.grid.shape)
    except ValueError as error:
        raise DatasetError(f"{maps.sources[0].name}: {error}") from None
    check_alike([checks.sources[0], maps.sources[0]])
    if len(maps) < processes:
        raise TrainingError(f"{len(maps)} training samples do not go round {processes} processes; use fewer")
    if config.batch % processes:
        raise TrainingError(f"--batch {config.batch} does not divide among {processes} processes; give a multiple")
    if len(maps) < config.batch and len(maps) % processes:
        raise TrainingError(
            f"{len(maps)} training samples, fewer than --batch {config.batch}, do not divide among {processes} "
            f"processes; give --batch {len(maps) // processes * processes}"
        )


def describe(maps: Maps, config: TrainConfig, precision: torch.dtype) -> dict[str, Any]:
    """What decides a run: a run with another description is another run."""
    return {
        "datasets": [source.digest for source in maps.sources],
        "kinds": [source.kind for source in maps.sources],
        "samples": None if maps.order(config.batch) else len(maps),
        **({} if maps.shares is None else {"shares": [str(share) for share in maps.shares]}),
        **dataclasses.asdict(config),
        "precision": str(precision).removeprefix("torch."),
    }


def _begin_from(weights: Path, network: Network) -> str:
    """Give `network` the weights in a file, and return the file's SHA-256. Raises CheckpointError for another one."""
    found = load_network(weights)[0]
    if found.config != network.config:
        unlike = "; ".join(differences(dataclasses.asdict(found.config), dataclasses.asdict(network.config)))
        raise CheckpointError(f"{weights}: another network than the one to train: {unlike}")
    network.load_state_dict(found.state_dict())
    return hashlib.sha256(weights.read_bytes()).hexdigest()


def _diverged(maps: Maps, batch: list[tuple[int, int]], progress: Progress, losses: dict[str, float]) -> str:
    found = ", ".join(f"{name} {value:.4g}" for name, value in losses.items())
    names = "; ".join(maps.name(index) for index, _ in batch)
    return (
        f"training diverged in epoch {progress.epoch + 1}, step {progress.step + 1}: {found}; lower --lr, or look at "
        f"the batch: {names}"
    )
