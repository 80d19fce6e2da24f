"""Training and the bench in one call each: `scenegen.train` and `scenegen.bench`."""

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
    """Train a completion network, or go on with a run, as `scenegen train` does.

    Args:
        training: What is trained on: a dataset, several in a list, or a mapping of datasets to
            weights, in proportion to which their samples come. In a list, a stream, or any object
            with the attributes of `scenegen.model.training.data.Samples`, can stand for a dataset.
        validation: What validates, in the same forms, of which weights do not count; by default
            the val splits of `training`, which must then be datasets.
        out: The run's folder; runs/<variant> by default.
        loss: The objective, or one of your own as "module:Object".
        weights: A network whose weights are the first ones; random by default.
        device: "cpu", "cuda", or "auto".
        workers: Processes that read samples.
        watcher: Callbacks of the run.
        settings: Fields of `NetworkConfig` (`variant`, `inputs`, `width`, …), of `LossConfig`
            (`occupancy`, `eikonal`, …) and of `TrainConfig` (`epochs`, `maps`, `batch`, `lr`, …).

    Returns:
        The network that the run keeps.

    Raises:
        ValueError: A setting is out of its bounds.
        TypeError: There is no such setting.
        DatasetError, TrainingError: Samples that do not go together, or a run that cannot go on.
    """
    config = TrainConfig.of({"objective": loss, **settings})
    folder = Path("runs", config.network.variant.rpartition(":")[2]) if out is None else Path(out)
    learned = _samples(training, "train")
    checked = _samples(training if validation is None else validation, "val")
    if any(one in learned for one in checked):
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
    network = config.network
    code = ",".join(filter(is_own, (network.variant, *network.inputs, *network.targets)))
    return Completer.from_pretrained(f"{code}@{folder}" if code else folder)


def bench(
    datasets: Any, methods: Any = USUAL, *, workers: int | None = None, **settings: Any
) -> dict[str, Any]:
    """Measure how well methods complete the maps of datasets, and how well paths are planned on
    what they predict, as `scenegen bench` does.

    Args:
        datasets: A dataset's folder or name, or several of different kinds in a list.
        methods: One, or several in a list; by default the rows of `scenegen bench`. Names of its
            `--method`, such as "extrude" or "my_methods:Grown"; or completers: networks, and
            objects with a `name` and a method `complete(observed, free, *, grid)` that gives a
            `scenegen.Prediction`. They travel to worker processes.
        workers: Processes of this machine; all cores by default.
        settings: Fields of `BenchConfig`: `split`, `samples`, `trials`, `seed`, `plan`, ….

    Returns:
        The report, as report.json holds it: ``report["reconstruction"][kind][method]["iou"]``,
        ``report["planning"][kind][method]["success"]``, each with its `mean`, its interval and the
        number `n` of values.

    Raises:
        DatasetError: There is no dataset, or its split is empty.
        PredictionError: What stands for a method is none, or predicts what cannot be.
        ScenegenError: There is no such method, or two have one name.
    """
    config = BenchConfig(**settings)
    rows = rows_of(
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
    """The samples of one split of all that `datasets` names."""
    if isinstance(datasets, Mapping):
        return opened(datasets if split == "train" else [*datasets], split)
    found, named = _listed(datasets), (str, Path, AnyDataset)
    # all at once, so that two datasets that share samples are found
    there = iter(opened([one for one in found if isinstance(one, named)], split))
    return [next(there) if isinstance(one, named) else one for one in found]


def _listed(value: Any) -> Sequence[Any]:
    """A list, of one where `value` is none."""
    return value if isinstance(value, list | tuple) else [value]
