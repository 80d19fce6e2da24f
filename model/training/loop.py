"""Train a completion network: a seeded loop that continues after an interruption anywhere."""

import itertools
import math
import platform
import time
from collections.abc import Callable, Mapping, Sequence
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
    own_code,
    reraise_as,
)
from scenegen.base.executors import commit, installed, software
from scenegen.base.files import Json
from scenegen.dataset.locate import file_sha256
from scenegen.dataset.parameters import differences, mapping_entry, sensor_entry
from scenegen.model.bench.metrics import measure, metrics_of
from scenegen.model.checkpoint import DTYPES, CheckpointError
from scenegen.model.completion.completer import locate, open_network
from scenegen.model.completion.protocol import Prediction, PredictionError, check_prediction
from scenegen.model.config import FIGURES, VARIANTS, TrainConfig, is_own
from scenegen.model.losses import loss_of, summed
from scenegen.model.network import Batch, Output, build_network, placed
from scenegen.model.targets import BUILT_IN
from scenegen.model.training.card import Scalars
from scenegen.model.training.data import (
    Key,
    Maps,
    Samples,
    check_alike,
    load_batches,
    loaders_watched,
)
from scenegen.model.training.device import (
    Group,
    TrainingError,
    autocast,
    choose_device,
    device_name,
    resolve_precision,
)
from scenegen.model.training.run_folder import CONFIG, Progress, RunFolder
from scenegen.model.training.schedule import Schedule, scored_map, validate, validated_metrics

PACKAGES = ("torch", "safetensors")
"""Packages whose versions a network's file records, besides those that a dataset records."""


@dataclass(frozen=True, kw_only=True)
class Watcher:
    """Callbacks of a run; `stop` may end it."""

    on_start: Callable[[int, int, int], None] = lambda epoch, total, finished: None
    """Called when an epoch begins or continues, with its number from 0, its number of maps, and how
    many of them an earlier process has finished."""
    on_step: Callable[[int, float], None] = lambda maps, loss: None
    """Called after each step with its number of maps and its loss."""
    on_epoch: Callable[[Scalars], None] = lambda row: None
    """Called after each epoch with its figures."""
    stop: Callable[[], bool] = lambda: False
    """Called after each step; if it returns True, the state is saved and training ends."""


def train(
    training: Sequence[Samples],
    validation: Sequence[Samples],
    config: TrainConfig,
    out: Path,
    *,
    device: str = "auto",
    workers: int = 0,
    command: str = "",
    watcher: Watcher | None = None,
    weights: str | Path | None = None,
) -> list[Scalars]:
    """Train a network, and keep the best one in a folder.

    If the folder holds a run with the same settings, it continues. A finished run stays as it is.
    Under ``torchrun``, each process takes its share of each batch. After any error, the last good
    state is in the folder, and the same call continues.

    Args:
        training: Samples to train on.
        validation: Samples for validation, with the same grid.
        config: Settings of the run.
        out: Folder of the run.
        device: See `choose_device`.
        workers: Processes that read samples; 0 to read in this one.
        command: Command line, which the network's file records.
        watcher: Callbacks.
        weights: Name of a network with the settings of `config.network`, to begin with; by default,
            weights are random.

    Returns:
        Figures of each epoch.

    Raises:
        DatasetError: if the samples do not fit together or cannot be read, if the disk refuses, or
            if the folder holds a run with other settings.
        CheckpointError: if `weights`, or the state in the folder, does not fit.
        TrainingError: if the device cannot be used, memory runs out, a loss is not finite, or a
            user's own network, target or loss is invalid.
        StoppedError: if `watcher` stops the run.
    """
    watcher, torch_device = watcher or Watcher(), choose_device(device)
    channels = config.network.inputs, config.network.targets
    maps, checks = Maps(training, "train", *channels), Maps(validation, "val", *channels)
    variant, sizes = config.network.variant, dict[str, Any]()
    # sizes that follow from the data; networks that do not depend on the height take any
    if is_own(variant) or VARIANTS[variant].columns:
        sizes["height"] = maps.grid.shape[2]
    if config.network.targets:
        sizes["channels"] = maps.channels()
    config = replace(config, network=replace(config.network, **sizes))
    precision = config.precision
    # "auto" may mean another type on this machine than on the one where the run was begun
    if precision == "auto" and (out / CONFIG).exists():
        precision = RunFolder(out).settings()["precision"]
    dtype = resolve_precision(precision, torch_device, maps.grid.shape)
    group = Group(torch_device, dtype)
    with loaders_watched(), group, closing(RunFolder(out, writes=group.first)) as folder:
        check_maps(maps, checks, config, group.size)
        schedule = Schedule(maps, config)
        torch.manual_seed(config.seed)
        network = placed(build_network(config.network), torch_device)
        settings = describe(maps, config, dtype)
        if weights is not None:
            settings["weights"] = begin_from(weights, network)
        rehearse(network, config, checks, torch_device)
        metadata = {"settings": settings, **describe_origin(maps, command, torch_device)}
        group.first_alone(lambda: folder.open(metadata))
        optimizer = optimizer_of(network, config)
        progress = folder.restore(network, optimizer)
        learn = Step(network, optimizer, config, maps.grid, group)
        while steps := schedule.steps(progress):
            # a continued epoch began earlier, and has finished some steps
            begin, finished = time.monotonic() - progress.seconds, progress.step
            watcher.on_start(progress.epoch, len(steps) * schedule.batch, finished * schedule.batch)
            network.train()
            # loaders read ahead of the steps, so the keys are iterated twice
            batches, ahead = itertools.tee(
                schedule.batches(steps.start + finished, len(steps) - finished)
            )
            mine = (batch[group.rank :: group.size] for batch in ahead)
            read = load_batches(maps, mine, workers=workers, pinned=torch_device.type == "cuda")
            with closing(read):
                for step, batch, tensors in zip(steps[finished:], batches, read, strict=False):
                    # a user's own network may draw, as dropout does; a continued run draws the same
                    torch.manual_seed(config.seed + step * group.size + group.rank)
                    losses = learn(tensors, schedule.rate(step, progress.decay))
                    check_finite(losses, maps, batch, progress)
                    progress.add(losses, seconds=time.monotonic() - begin)
                    watcher.on_step(len(batch), losses["loss"])
                    # a signal may reach one process only, but all must stop at the same step
                    if group.any(watcher.stop()):
                        folder.save(progress)
                        raise StoppedError(f"stopped; the same command goes on with {out}")
                    folder.save_in_time(progress)
            group.share_statistics(network)
            validated = validate(network, checks, config, group, workers)
            check_finite({"validation loss": validated["loss"]}, maps, [], progress)
            seconds = time.monotonic() - begin
            row = progress.close(validated, maps=steps.stop * schedule.batch, seconds=seconds)
            # the others wait, so that none returns before the network is written
            group.first_alone(
                lambda: folder.close_round(progress, network, maps.grid, metadata, config.choose)
            )
            watcher.on_epoch(row)
        folder.draw_rows(progress.rows)
        return progress.rows


def check_finite(losses: Scalars, maps: Maps, batch: list[Key], progress: Progress) -> None:
    """Check that losses are finite.

    Args:
        losses: Losses by name.
        maps: Training maps.
        batch: Keys of the batch, whose samples the message names; empty for validation.
        progress: Progress of the run, for the message.

    Raises:
        TrainingError: if a loss is NaN or infinite.
    """
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
    """One step of the optimiser: loss, gradient, update."""

    network: nn.Module
    """On the device of `group`."""
    optimizer: torch.optim.Optimizer
    config: TrainConfig
    grid: GridSpec
    group: Group

    def __post_init__(self) -> None:
        targets: Any = self.network.targets
        self._loss = loss_of(self.config.loss, self.grid, self.group.divisor, targets)
        self._has_step = hasattr(self.network, "training_step")
        # `DistributedDataParallel` and the compiler see forward passes only
        model = OwnStep(self.network) if self._has_step else self.network
        if self.group.size > 1:
            # torch has this for GPUs only; on CPUs, each process normalises its share of a batch
            if self.group.device.type == "cuda":
                model = nn.SyncBatchNorm.convert_sync_batchnorm(model)
            # a user's own network may have weights that a step does not use; looking for them costs
            # time, and ours have none
            unused = is_own(self.config.network.variant)
            model = DistributedDataParallel(model, find_unused_parameters=unused)
        self._model = torch.compile(model) if self.config.compile else model

    def __call__(self, batch: Batch, rate: float) -> Scalars:
        """Take one step.

        Args:
            batch: This process's share of the batch.
            rate: Learning rate.

        Returns:
            Losses by name before the update, and the norm of the gradient as ``gradient``; means
            over all processes.

        Raises:
            TrainingError: if memory runs out, or torch cannot compile the network.
        """
        for parameters in self.optimizer.param_groups:
            parameters["lr"] = rate
        try:
            return self.group.mean(self._learn(batch))
        except (RuntimeError, MemoryError) as error:
            if is_out_of_memory(error):
                maps = len(batch["occupancy"]) * self.group.size
                message = f"out of memory: a batch of {maps} does not fit; give a smaller --batch"
            elif type(error).__module__.startswith("torch._"):  # the compiler's own errors
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
            result = self._model(batch)
        losses = summed(result) if self._has_step else self._loss(Output(*result), batch)
        losses["loss"].backward()
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), self.config.clip)
        # else the weights stay good, and `check_finite` ends the run
        if torch.isfinite(norm):
            self.optimizer.step()
        return {name: value.item() for name, value in losses.items()} | {"gradient": norm.item()}


class OwnStep(nn.Module):
    """The `training_step` of a user's own network as a forward pass."""

    def __init__(self, network: Any):
        super().__init__()
        self.network = network

    def forward(self, batch: Batch) -> Any:
        """Return the losses of a batch; see docs/own-network.md."""
        return self.network.training_step(batch)


class Muon(torch.optim.AdamW):
    """Muon (Jordan et al. 2024) for filters of convolutions, AdamW for all other parameters.

    A step moves filters along their orthogonalised momentum.
    """

    MOMENTUM = 0.95
    QUINTIC = 3.4445, -4.775, 2.0315
    """Coefficients of a polynomial that brings singular values near 1 in five iterations (Jordan et
    al. 2024)."""
    STEP_SIZE = 0.6
    """Scale of a step: three times that of AdamW, which is better from random weights (docs/log).
    0.2 would be the size of AdamW (Liu et al. 2025)."""

    @torch.no_grad()
    def step(self, closure: Any = None) -> Any:
        """See `torch.optim.Optimizer.step`."""
        for group in self.param_groups:
            for filters in group["params"]:
                if filters.ndim < 3 or filters.grad is None:
                    continue
                state = self.state[filters]
                if not state:  # AdamW expects "step" in all states when it is copied
                    state.update(step=torch.zeros(()), momentum=torch.zeros_like(filters))
                momentum = state["momentum"].lerp_(filters.grad, 1 - self.MOMENTUM)
                # Nesterov's momentum; a filter is a matrix with a row for each output channel
                rows = filters.grad.lerp(momentum, self.MOMENTUM).flatten(1)
                size = self.STEP_SIZE * math.sqrt(max(rows.shape))
                filters.mul_(1 - group["lr"] * group["weight_decay"])
                filters.sub_(self._orthogonal(rows).view(filters.shape), alpha=group["lr"] * size)
                filters.grad = None  # so that AdamW skips them
        return super().step(closure)

    def _orthogonal(self, rows: Tensor) -> Tensor:
        """Return approximately the nearest matrix whose singular values are all 1."""
        if rows.shape[0] > rows.shape[1]:  # so that `square` is the smaller product
            return self._orthogonal(rows.T).T
        a, b, c = self.QUINTIC
        wide = rows / (rows.norm() + 1e-7)  # singular values of at most 1, as the iteration needs
        for _ in range(5):
            square = wide @ wide.T
            wide = a * wide + (b * square + c * square @ square) @ wide
        return wide


def optimizer_of(network: nn.Module, config: TrainConfig) -> torch.optim.Optimizer:
    """Make the optimiser.

    Args:
        network: The network.
        config: Settings of the run.

    Returns:
        Muon or AdamW. Weight decay is applied to matrices and filters; to biases and scales of
        norms only with `config.decay_all`.
    """
    groups: dict[float, list[nn.Parameter]] = {config.weight_decay: [], 0.0: []}
    for parameter in network.parameters():
        groups[config.weight_decay if config.decay_all or parameter.ndim > 1 else 0.0].append(
            parameter
        )
    options = [{"params": params, "weight_decay": decay} for decay, params in groups.items()]
    kind = torch.optim.AdamW if config.optimizer == "adamw" else Muon
    return kind(options, lr=config.lr)


def check_maps(maps: Maps, checks: Maps, config: TrainConfig, processes: int) -> None:
    """Check that a network can be trained on some maps.

    Args:
        maps: Training maps.
        checks: Validation maps.
        config: Settings of the run.
        processes: Number of processes that share each batch.

    Raises:
        DatasetError: if a split is empty, the network does not take the grid, or grids differ.
        TrainingError: if a batch cannot be divided equally among the processes.
    """
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
    """Describe all that a run's result depends on; a run continues only with the same description.

    Args:
        maps: Training maps.
        config: Settings of the run.
        precision: Type in which the network computes.

    Returns:
        JSON: the settings, and the datasets with digests, kinds, number of samples and weights.
    """
    return {
        "datasets": [source.digest for source in maps.sources],
        "kinds": [source.kind for source in maps.sources],
        "samples": None if maps.order(config.batch) else len(maps),
        **({} if maps.shares is None else {"shares": [str(share) for share in maps.shares]}),
        **asdict(config),
        "precision": str(precision).removeprefix("torch."),
    }


def describe_origin(maps: Maps, command: str, device: torch.device) -> Json:
    """Describe the origin of a network, besides its settings.

    Args:
        maps: Training maps.
        command: Command line.
        device: Device of the training.

    Returns:
        JSON: command, commit, versions, device, and sensor, noise and mapping of the samples; under
        ``also``, those of further parts of a dataset that differ.
    """
    python = {"python": platform.python_version()}
    software_entry = {
        "command": command,
        "commit": commit(),
        "versions": software() | python | {name: installed(name) for name in PACKAGES},
        "device": device_name(device),
    }
    # a completion compares its sensor with these entries: one for each sensor and mapping
    noises_of: dict[tuple[Any, Any], set[str]] = {}
    for lidar, mapping, noise in maps.settings:
        noises_of.setdefault((lidar, mapping), set()).add(noise)
    first, *further = [
        {"lidar": sensor_entry(lidar)}
        | ({"noise": sorted(noises)} if any(noises) else {})
        | ({} if mapping.plain else {"mapping": mapping_entry(mapping)})
        for (lidar, mapping), noises in noises_of.items()
    ]
    return software_entry | first | ({"also": further} if further else {})


def rehearse(network: Any, config: TrainConfig, maps: Maps, device: torch.device) -> None:
    """Try a user's own network, inputs, target, metrics or loss on one map: faults are reported at
    once.

    Does nothing if all of them come with scenegen.

    Args:
        network: The network, on the device.
        config: Settings of the run.
        maps: Maps, of which the first is tried.
        device: The device.

    Raises:
        TrainingError: if shapes, types or values are invalid, if a term of the loss has a reserved
            name, or if the loss does not depend on a weight.
        ScenegenError: if the user's code fails, or the name of a target's metric is taken.
    """
    variant, objective = config.network.variant, config.loss.objective
    targets = config.network.targets
    if not (targets or any(map(is_own, (variant, objective, *config.network.inputs)))):
        return
    batch = {name: values[None].to(device) for name, values in maps[0].items()}
    with own_code(f"variant {variant}: expected a method forward(batch)"):
        raw = network.eval()(batch)
    # a result of another kind is compared below like one of a wrong shape
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
    # the same check as for predictions of any method: probabilities from 0 to 1, finite numbers
    failing = own_code(f"target {', '.join(targets)}: expected a method prediction(output, grid)")
    with torch.no_grad(), reraise_as(TrainingError, of=PredictionError), failing:
        predicted = output.predictions(network.targets, maps.grid)
        check_prediction(Prediction.of(predicted), (1, *maps.grid.shape), f"variant {variant}")
    for name, value in network.state_dict().items():  # files hold no other types
        if value.dtype not in DTYPES:
            raise TrainingError(
                f"variant {variant}: {name} is {value.dtype}, expected float32 or int64"
            )
    terms = _rehearsed_losses(network, config, maps.grid, output, batch)
    arrays, truth = (
        {name: values[0].numpy(force=True) for name, values in held.items()}
        for held in (predicted, batch)
    )
    scored = scored_map(Prediction.of(arrays), truth, maps.grid)
    measure(scored, validated_metrics(network.targets))
    if config.choose not in (*terms, "last"):
        raise TrainingError(
            f"choose = {config.choose!r}: the loss has no such term, but {', '.join(terms)}"
        )


def _rehearsed_losses(
    network: Any, config: TrainConfig, grid: GridSpec, output: Output, batch: Batch
) -> Mapping[str, Tensor]:
    """Compute the loss of a map, and try `training_step` if the network has one; return the terms
    of the loss. Raises TrainingError or OwnCodeError as `rehearse` does."""
    targets, objective = config.network.targets, config.loss.objective
    if targets and not is_own(objective):
        source = f"loss of target {', '.join(targets)}"
        expected = "a method (output, batch, objective) -> scalar tensor, or it and a dict of terms"
    else:
        source = f"loss {objective}"
        expected = (
            "a function (output, batch), or a class (config, grid) of one -> scalar tensor, or a "
            "dict of such"
        )
    with own_code(f"{source}: expected {expected}"):
        terms = loss_of(config.loss, grid, targets=network.targets)(output, batch)
    losses_by_source = {source: terms}
    if hasattr(network, "training_step"):
        # then it is minimised instead; the loss still validates
        source = f"training_step of variant {config.network.variant}"
        with own_code(f"{source}: expected a method (batch) -> scalar tensor, or a dict of such"):
            losses_by_source[source] = summed(network.training_step(batch))
    taken = {*metrics_of(network.targets), *FIGURES}
    for title, losses in losses_by_source.items():
        for name, value in losses.items():
            if not isinstance(value, Tensor) or value.ndim or name in taken:
                raise TrainingError(
                    f"{title}: {name} is {value!r:.60}; expected a scalar tensor, or a dict of "
                    "such under names that no metric has"
                )
    if not (loss := losses_by_source[source]["loss"]).requires_grad:
        raise TrainingError(
            f"{source}: gives {loss:.3g}; no weight of variant {config.network.variant} changes it"
        )
    return terms


def begin_from(weights: str | Path, network: Any) -> str:
    """Copy the weights of another network.

    Args:
        weights: Name of that network; see `Completer.from_pretrained`.
        network: The network to train, which is changed.

    Returns:
        SHA-256 of the file of `weights`, which is part of the run's settings.

    Raises:
        CheckpointError: if there is no such network, or it has other settings than `network`.
    """
    source = open_network(weights)[0]
    if source.config != network.config:
        unlike = "; ".join(differences(asdict(source.config), asdict(network.config)))
        raise CheckpointError(f"{weights}: another network than the one to train: {unlike}")
    network.load_state_dict(source.state_dict())
    return file_sha256(locate(weights))
