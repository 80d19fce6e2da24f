"""Train a completion network: one plain loop, seeded, that can be interrupted anywhere and goes
on."""

import itertools
import math
import platform
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from lidarsim import GridSpec
from scenegen.base.errors import (
    DatasetError,
    StoppedError,
    empty_split,
    is_out_of_memory,
    reraise_as,
)
from scenegen.base.executors import commit, installed, software
from scenegen.base.files import Json
from scenegen.dataset.locate import file_sha256
from scenegen.dataset.parameters import differences, mapping_entry, sensor_entry
from scenegen.model.bench.metrics import metrics_of
from scenegen.model.checkpoint import DTYPES, CheckpointError
from scenegen.model.completion.completer import locate, open_network
from scenegen.model.completion.protocol import Prediction, PredictionError, check_prediction
from scenegen.model.config import VARIANTS, TrainConfig, is_own
from scenegen.model.losses import loss_of, summed
from scenegen.model.network import Batch, Output, build, placed
from scenegen.model.targets import BUILT_IN
from scenegen.model.training.card import Scalars
from scenegen.model.training.course import Course, validate
from scenegen.model.training.data import Key, Maps, Samples, check_alike, load, loaders_watched
from scenegen.model.training.device import (
    Group,
    TrainingError,
    autocast,
    choose_device,
    device_name,
    resolve_precision,
)
from scenegen.model.training.run_folder import CONFIG, Progress, RunFolder

RESERVED = ("largest", "gradient", "best_iou", "best_probability", "best_distance_m")
"""Names of a run's figures, besides metrics, that no term of a loss may have."""
PACKAGES = ("torch", "safetensors")
"""What a trained network depends on, besides what a dataset does."""


@dataclass(frozen=True, kw_only=True)
class Watcher:
    """Callbacks of a run; `stop` may end it."""

    on_start: Callable[[int, int, int], None] = lambda epoch, total, done: None
    """Called when an epoch begins, with its number from 0, its maps, and how many of them are
    done."""
    on_step: Callable[[int, float], None] = lambda maps, loss: None
    """Called with the maps and the loss of every step."""
    on_epoch: Callable[[Scalars], None] = lambda row: None
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
    weights: str | Path | None = None,
) -> list[Scalars]:
    """Train on the samples in `training`, validate on those in `checking`, keep the best network in
    `out`.

    A run with the same settings that `out` holds already goes on where it was; one that is finished
    stays as it is. The first weights are random, or those of the network called `weights`, which
    must be of `config.network`. Under ``torchrun`` every process takes its part of each batch.
    Returns the figures of every epoch. Raises DatasetError, CheckpointError, TrainingError, and
    StoppedError when `watcher` asks to stop; whatever is raised, the last good state stays in
    `out`.
    """
    watcher, where = watcher or Watcher(), choose_device(device)
    channels = config.network.inputs, config.network.targets
    maps, checks = Maps(training, "train", *channels), Maps(checking, "val", *channels)
    variant, sizes = config.network.variant, dict[str, Any]()
    if is_own(variant) or VARIANTS[variant].columns:  # which is built for the maps' height
        sizes["height"] = maps.grid.shape[2]
    if config.network.targets:
        sizes["channels"] = maps.channels()
    config = replace(config, network=replace(config.network, **sizes))
    precision = config.precision
    if precision == "auto" and (out / CONFIG).exists():  # a run keeps what it was begun with
        precision = RunFolder(out).settings()["precision"]
    dtype = resolve_precision(precision, where, maps.grid.shape)
    group = Group(where, dtype)
    with loaders_watched(), group, closing(RunFolder(out, writes=group.first)) as folder:
        check_maps(maps, checks, config, group.size)
        course = Course(maps, config)
        torch.manual_seed(config.seed)
        network = placed(build(config.network), where)
        settings = describe(maps, config, dtype)
        if weights is not None:
            settings["weights"] = begin_from(weights, network)
        rehearse(network, config, checks, where)
        about = {"settings": settings, **origin(maps, command, where)}
        group.first_alone(lambda: folder.open(about))
        optimizer = optimizer_of(network, config)
        progress = folder.restore(network, optimizer)
        learn = Step(network, optimizer, config, maps.grid, group)
        while steps := course.steps(progress):
            begin, done = time.monotonic() - progress.seconds, progress.step
            watcher.on_start(progress.epoch, len(steps) * course.batch, done * course.batch)
            network.train()
            batches, ahead = itertools.tee(course.batches(steps.start + done, len(steps) - done))
            mine = (batch[group.rank :: group.size] for batch in ahead)
            read = load(maps, mine, workers=workers, pinned=where.type == "cuda")
            with closing(read):
                for step, batch, tensors in zip(steps[done:], batches, read, strict=False):
                    # a user's own network may draw, as dropout does
                    torch.manual_seed(config.seed + step * group.size + group.rank)
                    losses = learn(tensors, course.rate(step, progress.decay))
                    check_finite(losses, maps, batch, progress)
                    progress.add(losses, seconds=time.monotonic() - begin)
                    watcher.on_step(len(batch), losses["loss"])
                    if group.any(watcher.stop()):
                        folder.save(progress)
                        raise StoppedError(f"stopped; the same command goes on with {out}")
                    folder.save_in_time(progress)
            group.share_statistics(network)
            validated = validate(network, checks, config, group, workers)
            check_finite({"validation loss": validated["loss"]}, maps, [], progress)
            seconds = time.monotonic() - begin
            row = progress.close(validated, maps=steps.stop * course.batch, seconds=seconds)
            group.first_alone(  # and nobody opens a network before it is there
                lambda: folder.close_round(progress, network, maps.grid, about, config.choose)
            )
            watcher.on_epoch(row)
        folder.draw_rows(progress.rows)
        return progress.rows


def check_finite(losses: Scalars, maps: Maps, batch: list[Key], progress: Progress) -> None:
    """Raise TrainingError, which names the batch's samples, where a loss is not finite."""
    if all(map(math.isfinite, losses.values())):
        return
    figures = ", ".join(f"{name} {value:.4g}" for name, value in losses.items())
    names = "; ".join(maps.name(index) for index, _ in batch) or "that of validation"
    raise TrainingError(
        f"training diverged in epoch {progress.epoch + 1}, step {progress.step + 1}: {figures}; "
        f"lower --lr, or look at the batch: {names}"
    )


@dataclass
class Step:
    """One optimiser step: loss, gradient, update."""

    network: nn.Module
    optimizer: torch.optim.Optimizer
    config: TrainConfig
    grid: GridSpec
    group: Group

    def __post_init__(self) -> None:
        targets: Any = self.network.targets
        self._loss = loss_of(self.config.loss, self.grid, self.group.divisor, targets)
        self._own = hasattr(self.network, "training_step")
        model = OwnStep(self.network) if self._own else self.network
        if self.group.size > 1:
            if self.group.device.type == "cuda":  # elsewhere, each process normalises its part
                model = nn.SyncBatchNorm.convert_sync_batchnorm(model)
            own = is_own(self.config.network.variant)  # and may have weights that it does not use
            model = DistributedDataParallel(model, find_unused_parameters=own)
        self._model = torch.compile(model) if self.config.compile else model

    def __call__(self, batch: Batch, rate: float) -> Scalars:
        """The losses of a batch and the norm of their gradient, before learning from it: means over
        all processes.

        Raises TrainingError where memory runs out, or torch cannot compile.
        """
        for parameters in self.optimizer.param_groups:
            parameters["lr"] = rate
        try:
            return self.group.mean(self._learn(batch))
        except (RuntimeError, MemoryError) as error:
            if is_out_of_memory(error):
                maps = len(batch["occupancy"]) * self.group.size
                message = f"out of memory: a batch of {maps} does not fit; give a smaller --batch"
            elif type(error).__module__.startswith("torch._"):  # what `--compile` calls
                message = f"--compile: {str(error).partition(chr(10))[0]}; leave it out"
            else:
                raise
            raise TrainingError(message) from None

    def _learn(self, batch: Batch) -> Scalars:
        batch = {
            name: values.to(self.group.device, non_blocking=True) for name, values in batch.items()
        }
        self.optimizer.zero_grad()
        with autocast(self.group.device, self.group.precision):
            given = self._model(batch)
        losses = summed(given) if self._own else self._loss(Output(*given), batch)
        losses["loss"].backward()
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), self.config.clip)
        if torch.isfinite(norm):  # otherwise the weights stay as they were, and the caller sees why
            self.optimizer.step()
        return {name: value.item() for name, value in losses.items()} | {"gradient": norm.item()}


class OwnStep(nn.Module):
    """The `training_step` of a user's own network as a forward pass, which several processes
    share."""

    def __init__(self, network: Any):
        super().__init__()
        self.network = network

    def forward(self, batch: Batch) -> Any:
        """The losses of a batch."""
        return self.network.training_step(batch)


class Muon(torch.optim.AdamW):
    """Filters of convolutions by Muon (Jordan et al. 2024), everything else by AdamW.

    A step moves filters along their momentum, made orthogonal. It is three times as long as AdamW's
    would be (once in Liu et al. 2025), which is better from random weights (docs/log).
    """

    MOMENTUM = 0.95
    QUINTIC = 3.4445, -4.775, 2.0315
    """Of the polynomial that brings singular values near 1 in five rounds (Jordan et al.)."""

    @torch.no_grad()
    def step(self, closure: Any = None) -> Any:
        """See torch.optim.Optimizer."""
        for group in self.param_groups:
            for filters in group["params"]:
                if filters.ndim < 3 or filters.grad is None:
                    continue
                state = self.state[filters]
                if not state:  # "step" is what AdamW looks for when it is copied
                    state.update(step=torch.zeros(()), momentum=torch.zeros_like(filters))
                momentum = state["momentum"].lerp_(filters.grad, 1 - self.MOMENTUM)
                rows = filters.grad.lerp(momentum, self.MOMENTUM).flatten(1)
                size = 0.6 * math.sqrt(max(rows.shape))
                filters.mul_(1 - group["lr"] * group["weight_decay"])
                filters.sub_(self._orthogonal(rows).view(filters.shape), alpha=group["lr"] * size)
                filters.grad = None  # nothing for AdamW to do
        return super().step(closure)

    def _orthogonal(self, rows: Tensor) -> Tensor:
        """The nearest matrix whose singular values are about 1."""
        if rows.shape[0] > rows.shape[1]:
            return self._orthogonal(rows.T).T
        a, b, c = self.QUINTIC
        wide = rows / (rows.norm() + 1e-7)
        for _ in range(5):
            square = wide @ wide.T
            wide = a * wide + (b * square + c * square @ square) @ wide
        return wide


def optimizer_of(network: nn.Module, config: TrainConfig) -> torch.optim.Optimizer:
    """The optimiser of the configuration; weight decay is for what multiplies features, and for
    vectors only where the configuration says so."""
    groups: dict[float, list[nn.Parameter]] = {config.weight_decay: [], 0.0: []}
    for parameter in network.parameters():
        groups[config.weight_decay if config.decay_all or parameter.ndim > 1 else 0.0].append(
            parameter
        )
    options = [{"params": params, "weight_decay": decay} for decay, params in groups.items()]
    kind = torch.optim.AdamW if config.optimizer == "adamw" else Muon
    return kind(options, lr=config.lr)


def check_maps(maps: Maps, checks: Maps, config: TrainConfig, processes: int) -> None:
    """Raise DatasetError or TrainingError where these splits cannot be trained on."""
    for split in (maps, checks):
        if not len(split):
            names = ", ".join(source.name for source in split.sources)
            raise DatasetError(f"{names}: {empty_split(split.split)}")
    with reraise_as(DatasetError, f"{maps.sources[0].name}: "):
        config.network.check_map(maps.grid.shape)
    check_alike([checks.sources[0], maps.sources[0]])
    batch = min(config.batch, len(maps))
    if batch % processes:
        raise TrainingError(
            f"{batch} training samples a step do not divide among {processes} processes; "
            f"give --batch {max(batch // processes, 1) * processes}"
        )


def describe(maps: Maps, config: TrainConfig, precision: torch.dtype) -> Json:
    """What decides a run: a run with another description is another run."""
    return {
        "datasets": [source.digest for source in maps.sources],
        "kinds": [source.kind for source in maps.sources],
        "samples": None if maps.order(config.batch) else len(maps),
        **({} if maps.shares is None else {"shares": [str(share) for share in maps.shares]}),
        **asdict(config),
        "precision": str(precision).removeprefix("torch."),
    }


def origin(maps: Maps, command: str, device: torch.device) -> Json:
    """What a network remembers of where it comes from, besides its settings."""
    python = {"python": platform.python_version()}
    about = {
        "command": command,
        "commit": commit(),
        "versions": software() | python | {name: installed(name) for name in PACKAGES},
        "device": device_name(device),
    }
    ways: dict[tuple[Any, Any], set[str]] = {}
    for lidar, mapping, noise in maps.settings:
        ways.setdefault((lidar, mapping), set()).add(noise)
    first, *others = [
        {"lidar": sensor_entry(lidar)}
        | ({"noise": sorted(noises)} if any(noises) else {})
        | ({} if mapping.plain else {"mapping": mapping_entry(mapping)})
        for (lidar, mapping), noises in ways.items()
    ]
    return about | first | ({"also": others} if others else {})


def rehearse(network: Any, config: TrainConfig, maps: Maps, device: torch.device) -> None:
    """Raise TrainingError where a network, a target or a loss of a user's own does not say of one
    map what it should; what comes with scenegen is not tried."""
    variant, objective = config.network.variant, config.loss.objective
    if not (is_own(variant) or is_own(objective) or config.network.targets):
        return
    batch = {name: values[None].to(device) for name, values in maps[0].items()}
    raw = network.eval()(batch)
    output = Output(*raw) if isinstance(raw, tuple) and len(raw) in (2, 3) else Output(raw, None)
    shapes = {name: getattr(values, "shape", values) for name, values in output.by_target.items()}
    expected = {}
    for name in network.targets:
        channels = config.network.channels_of(name)
        expected[name] = (1, *[channels] * (channels > 1), *maps.grid.shape)
    if shapes != expected or (output.tudf is not None and output.tudf.min() < 0):
        raise TrainingError(
            f"variant {variant}: gives {shapes!r:.200}, expected {expected}, by its `tasks`, and "
            "no negative distance"
        )
    if not shapes.keys() & BUILT_IN.keys():
        raise TrainingError(f"variant {variant}: expected occupancy, tudf or both among its tasks")
    with torch.no_grad(), reraise_as(TrainingError, of=PredictionError):
        predicted = Prediction.of(output.predictions(network.targets, maps.grid))
        check_prediction(predicted, (1, *maps.grid.shape), f"variant {variant}")
    for name, value in network.state_dict().items():
        if value.dtype not in DTYPES:
            raise TrainingError(
                f"variant {variant}: {name} is {value.dtype}, expected float32 or int64"
            )
    terms = loss_of(config.loss, maps.grid, targets=network.targets)(output, batch)
    steps = summed(network.training_step(batch)) if hasattr(network, "training_step") else {}
    taken = {*metrics_of(network.targets), *RESERVED}
    for name, value in [*terms.items(), *steps.items()]:
        if not isinstance(value, Tensor) or value.ndim or name in taken:
            raise TrainingError(
                f"loss {objective}: {name} is {value!r:.60}; expected a scalar tensor, or a dict "
                "of such under names that no metric has"
            )
    if not (steps or terms)["loss"].requires_grad:
        raise TrainingError(f"loss {objective}: no weight of variant {variant} changes it")
    if config.choose not in (*terms, "last"):
        raise TrainingError(
            f"choose = {config.choose!r}: the loss has no such term, but {', '.join(terms)}"
        )


def begin_from(weights: str | Path, network: Any) -> str:
    """Give `network` the weights of another one, and return their file's SHA-256. Raises
    CheckpointError where that is another network."""
    source = open_network(weights)[0]
    if source.config != network.config:
        there, asked = (asdict(one.config) for one in (source, network))
        unlike = "; ".join(differences(there, asked))
        raise CheckpointError(f"{weights}: another network than the one to train: {unlike}")
    network.load_state_dict(source.state_dict())
    return file_sha256(locate(weights))
