"""`scenegen.train` and `scenegen.bench`: training and the bench in one call each."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from scenegen.base.errors import DatasetError
from scenegen.base.executors import cores
from scenegen.base.workers import Local
from scenegen.dataset.collection import open_data
from scenegen.dataset.read import AnyDataset
from scenegen.model.bench.methods import Completed, rows_of
from scenegen.model.bench.report import build_report
from scenegen.model.bench.run import bench_all
from scenegen.model.completion.completer import Completer
from scenegen.model.config import USUAL, BenchConfig, TrainConfig, is_own
from scenegen.model.training.data import Samples, opened
from scenegen.model.training.loop import Watcher
from scenegen.model.training.loop import train as run


def train(
    training: Any,
    validation: Any = None,
    *,
    out: str | Path | None = None,
    loss: str = "coupled",
    weights: str | Path | None = None,
    device: str = "auto",
    workers: int = 0,
    watcher: Watcher | None = None,
    **settings: Any,
) -> Completer:
    """Train a completion network, or continue a run, as `scenegen train` does.

    Args:
        training: Training data: a dataset, a list of several, or a mapping of datasets to weights.
            Samples are drawn in proportion to the weights. A list may also have a stream, or any
            object with the attributes of `scenegen.model.training.data.Samples`.
        validation: Validation data, in the same forms; weights are ignored. By default, the val
            splits of `training`, which must then be datasets.
        out: Folder of the run; by default runs/VARIANT.
        loss: Name of the loss; your own as "module:Object".
        weights: Name of a network to begin with; by default, weights are random.
        device: "cpu", "cuda", or "auto", which is a GPU if there is one.
        workers: Processes that read samples; 0 to read in this one.
        watcher: Callbacks of the run.
        settings: Fields of `NetworkConfig` (`variant`, `inputs`, `width`, …), of `LossConfig`
            (`occupancy`, `eikonal`, …) and of `TrainConfig` (`epochs`, `maps`, `batch`, `lr`, …).

    Returns:
        The network that the run selected (`choose`).

    Raises:
        ValueError: if a setting is out of its bounds.
        TypeError: if there is no such setting.
        DatasetError: if a dataset is missing or damaged, if datasets do not fit together, or if
            `out` holds a run with other settings.
        CheckpointError: if `weights` is no network of these settings.
        TrainingError: if the device cannot be used, memory runs out, or the loss diverges.
        StoppedError: if `watcher` stops the run.
    """
    config = TrainConfig.of({"objective": loss, **settings})
    folder = Path("runs", config.network.variant.rpartition(":")[2]) if out is None else Path(out)
    learned = _samples(training, "train")
    checked = _samples(training if validation is None else validation, "val")
    # streams and a user's own samples have no splits, so both lists would have the same object
    if any(samples in learned for samples in checked):
        raise DatasetError("what is trained on has no val split of its own; give validation")
    run(
        learned,
        checked,
        config,
        folder,
        device=device,
        workers=workers,
        weights=weights,
        watcher=watcher,
        command="scenegen.train",
    )
    # the user named this code, so it may be imported again when the network is opened
    network = config.network
    code = ",".join(filter(is_own, (network.variant, *network.inputs, *network.targets)))
    return Completer.from_pretrained(f"{code}@{folder}" if code else folder)


def bench(
    datasets: Any, methods: Any = USUAL, *, workers: int | None = None, **settings: Any
) -> dict[str, Any]:
    """Measure completions of datasets, and plans on them, as `scenegen bench` does.

    Args:
        datasets: Folder or name of a dataset, or a list of several of different kinds.
        methods: A method, or a list of several; by default the rows of `scenegen bench`. A method
            is a name of `--method`, such as "extrude" or "my_methods:Grown", or a completer: a
            network, or an object with a `name` and a method
            `complete(observed, free, *, grid)` that returns a `scenegen.Prediction`. Completers are
            pickled for worker processes.
        workers: Processes on this machine; by default, one for each core.
        settings: Fields of `BenchConfig`: `split`, `samples`, `trials`, `seed`, `plan`, ….

    Returns:
        The report, as in report.json: ``report["reconstruction"][kind][method]["iou"]``,
        ``report["planning"][kind][method]["success"]``, each with its `mean`, its interval and the
        number `n` of values.

    Raises:
        ValueError: if a setting is out of its bounds.
        TypeError: if there is no such setting.
        DatasetError: if a dataset is missing, or its split is empty.
        PredictionError: if an object is not a completer, or a prediction is invalid.
        ScenegenError: if there is no such method, or two have the same name.
    """
    config = BenchConfig(**settings)
    rows = rows_of(
        # objects are checked now, not in a worker process
        [
            method if isinstance(method, str | Completer) else Completed(method)
            for method in _listed(methods)
        ]
        or USUAL
    )
    measured = [open_data(name) for name in _listed(datasets)]
    if not measured:
        raise DatasetError("bench: no datasets; give one, or several of different kinds")
    execute = Local("", cores() if workers is None else workers)
    results = bench_all(measured, rows, config, execute=execute)
    return build_report(results, seed=config.seed, about={"split": config.split})


def _samples(datasets: Any, split: str) -> list[Samples]:
    """Return the samples of one split, for each entry of `datasets`."""
    if isinstance(datasets, Mapping):
        return opened(datasets if split == "train" else [*datasets], split)
    entries, openable = _listed(datasets), (str, Path, AnyDataset)
    # opened all at once, so that two datasets that share samples are noticed
    samples = iter(opened([entry for entry in entries if isinstance(entry, openable)], split))
    return [next(samples) if isinstance(entry, openable) else entry for entry in entries]


def _listed(value: Any) -> Sequence[Any]:
    """Return `value`, in a list unless it is one."""
    return value if isinstance(value, list | tuple) else [value]
