"""Rows of the bench, by name: completers, the truth itself, and predictions in HDF5 files. Chooses
the best threshold of a method, too, by one rule for the bench and for training."""

import inspect
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from itertools import product
from pathlib import Path
from typing import Any, Protocol

import h5py
import numpy as np

from lidarsim.grid import Floats, Mask
from lidarsim.jit import kernel
from scenegen.base.errors import DatasetError, ScenegenError, printable, reraise_as
from scenegen.base.files import real_path
from scenegen.base.limits import GUARD_S
from scenegen.dataset.read import AnyDataset, Split
from scenegen.draw.sample import Sample, rng_of
from scenegen.draw.scored import scored_voxels
from scenegen.model.completion.protocol import (
    PARTS,
    MapCompleter,
    Prediction,
    PredictionError,
    check_prediction,
    complete_seen,
    extras_of,
    forget,
    plain,
)
from scenegen.model.completion.stored import check_file, pairs_in, prediction_at, read_guarded
from scenegen.model.config import METHODS, Thresholds, split_name
from scenegen.model.inputs import SeenMap
from scenegen.model.targets import Target
from scenegen.view.look import evenly


class Method(Protocol):
    """A row of the tables. Methods travel to worker processes."""

    name: str
    """How the method is called in tables."""
    learned: bool
    """Whether the method was trained, or may have been; not one that is only there to be compared
    with."""

    # a method that draws has `draws = True`, and its `completion` takes random numbers, too; one
    # with targets of its own has `targets`, by name

    def completion(self, sample: Sample, split: Split) -> Prediction:
        """Predict the map of a sample.

        Args:
            sample: The sample.
            split: Its split.
        """
        ...


class Completed:
    """A completer as a row of the bench. It sees the observations, and not the truth."""

    def __init__(self, completer: MapCompleter):
        name, complete = (getattr(completer, attribute, None) for attribute in ("name", "complete"))
        lacking = "a `name`, a string" if not isinstance(name, str) else ""
        # before any sample is read: a typo in a signature would show only in a worker
        try:
            extras = extras_of(completer)
            signature: Any = inspect.signature(complete)  # type: ignore[arg-type]
            signature.bind(None, None, grid=None, **dict.fromkeys(extras))
        except (AttributeError, TypeError, ValueError):
            lacking = "a method `complete` that takes (observed, free, *, grid)"
        if lacking:
            raise PredictionError(f"{type(completer).__name__}: lacks {lacking}")
        self._completer, self.name = completer, printable(name)
        self.learned = bool(getattr(completer, "learned", True))
        """Whatever the completer says of itself; one that says nothing may be."""
        self.targets: Mapping[str, Target] = getattr(completer, "targets", {})
        """Targets of its own, by name, whose metrics are measured."""
        self.draws = "rng" in extras

    def completion(
        self, sample: Sample, split: Split, rng: np.random.Generator | None = None
    ) -> Prediction:
        """See `Method.completion`.

        Args:
            sample: The sample.
            split: Its split.
            rng: Random numbers of a method that draws; by default, those of seed 0.

        Raises:
            PredictionError: The completer gives something else than a prediction.
        """
        grid = split.dataset.grid
        forget(self._completer)  # the maps of the bench are no sequence
        prediction = complete_seen(self._completer, SeenMap.of(sample), grid=grid, rng=rng)
        check_prediction(prediction, grid.shape, self.name, self.targets)
        # arrays of torch may be on a device; metrics compute in numpy
        further = {name: plain(values) for name, values in prediction.others.items()}
        parts = {name: plain(getattr(prediction, name)) for name in PARTS}
        return replace(prediction, **parts, others=further)


def answers(method: Any, sample: Sample, split: Split, *key: int, draws: int) -> list[Prediction]:
    """Ask a method for its answers on a sample.

    Args:
        method: A `Method`.
        sample: The sample, which is one of `split`'s.
        split: Its split.
        key: Seed and number of the map, which decide the random numbers of each draw.
        draws: How many answers a method that draws gives.

    Returns:
        So many predictions; one of a method that does not draw.
    """
    if not getattr(method, "draws", False):
        return [method.completion(sample, split)]
    return [method.completion(sample, split, rng_of(*key, draw)) for draw in range(draws)]


class Truth:
    """The truth as if it had been predicted: the ceiling of any map, for one planner. For later
    times it says the truth now."""

    name = "truth"
    learned = False

    def completion(self, sample: Sample, split: Split) -> Prediction:
        """See `Method.completion`.

        Args:
            sample: The sample.
            split: Its split.

        Returns:
            The true occupancy, whose transform is the distance.
        """
        return Prediction(occupancy_probability=sample.occupancy.astype(np.float32))


class Predicted:
    """Predictions in an HDF5 file, or in all such files of a folder: `occupancy_probability` and/or
    `tudf`, float32 (N, *grid.shape); optionally `probability`, calibrated; and which sample each
    row predicts: attribute `dataset` (the dataset's digest), `world` and `viewpoint`, int64 (N,),
    and `split`, an attribute."""

    learned = True

    def __init__(self, path: Path):
        self.path, real, is_folder = path, real_path(path), path.is_dir()
        self.name = printable(real.name if is_folder else real.stem)
        self._files = sorted(path.rglob("*.h5")) if is_folder else [path]

    def check(self, dataset: AnyDataset, split: str) -> None:
        """Check that the files predict every sample of a split once.

        Another process, with limits, reads all of each file first: HDF5 could make a small file
        large. That costs about as much as reading it.

        Args:
            dataset: The dataset.
            split: Name of the split.

        Raises:
            DatasetError: They do not, are of another grid, hold impossible numbers, or are not as
                they were written.
        """
        names = {(world, viewpoint) for _, world, viewpoint in dataset.split(split).names}
        shape = dataset.grid.shape
        facts = {"dataset": str(dataset.digest), "split": split}
        check = partial(check_file, facts=facts, max_samples=len(names), shape=shape)
        # a generous time for large splits: a million voxels a second
        seconds = GUARD_S + len(names) * math.prod(shape) / 1e6
        counts = Counter[tuple[int, int]]()
        for path in self._files:
            counts.update(read_guarded(check, path, 1 << 62, seconds))
        if odd := sorted(name for name in names if counts[name] != 1):
            raise DatasetError(
                f"{self.path}: {len(odd)} of {len(names)} samples are missing, or there twice, the "
                f"first is world {odd[0][0]}, viewpoint {odd[0][1]}; predict each sample of split "
                f"{split} once"
            )

    @cached_property
    def _rows(self) -> dict[tuple[str, int, int], tuple[Path, int]]:
        """File and row of every (split, world, viewpoint)."""
        # by names and not by position: the rows of a file may be in any order
        rows: dict[tuple[str, int, int], tuple[Path, int]] = {}
        for path in self._files:
            with h5py.File(path, "r") as file:
                split = str(file.attrs["split"])
                rows |= {(split, *pair): (path, row) for row, pair in enumerate(pairs_in(file))}
        return rows

    def completion(self, sample: Sample, split: Split) -> Prediction:
        """See `Method.completion`.

        Args:
            sample: The sample.
            split: Its split.

        Raises:
            KeyError: The sample is not predicted.
        """
        path, row = self._rows[split.name, int(sample.world), int(sample.viewpoint)]
        with h5py.File(path, "r") as file:
            return prediction_at(file, row)


def find_method(name: Any) -> Method:
    """Make a row of the bench.

    Args:
        name: A known name, or ``module:Class`` of a completer; a row is returned as it is.

    Returns:
        The row.

    Raises:
        ScenegenError: There is no such method, or the completer does not keep the protocol.
    """
    if not isinstance(name, str):
        return name
    with reraise_as(ScenegenError, "--method: "):
        kind = METHODS.find(name)
    odd = f"--method {name}: cannot be made by calling it without arguments: "
    with reraise_as(ScenegenError, odd, of=TypeError):
        method = kind()
    if name in METHODS.builtin and hasattr(method, "completion"):  # a row itself, not a completer
        return method
    return Completed(method)


def rows_of(
    methods: Sequence[Any], weights: Sequence[str] = (), predictions: Path | None = None
) -> list[Method]:
    """Make the rows of a bench.

    Args:
        methods: Names or rows, see `find_method`.
        weights: Networks, or NAME=network.
        predictions: A file or folder of predictions.

    Raises:
        ScenegenError: Two rows have one name, or one cannot be made.
    """
    rows = list(map(find_method, methods))
    if weights:
        from scenegen.model.completion.completer import Completer  # the other rows need no torch

        for name, place in map(split_name, weights):
            network = Completer.from_pretrained(place, threads=1)
            network.name = name or network.name
            rows.append(network)
    if predictions is not None:
        rows.append(Predicted(predictions))
    named = [row.name for row in rows]
    if twice := [name for name in named if named.count(name) > 1]:
        raise ScenegenError(
            f"two rows are called {twice[0]!r}; name a network's row, as in --weights "
            f"NAME=runs/mine, or rename a file or folder"
        )
    return rows


def check_rows(rows: Sequence[Method], datasets: Sequence[AnyDataset], split: str) -> None:
    """Check that files of predictions are of a split of all datasets.

    Args:
        rows: The rows.
        datasets: The datasets.
        split: Name of the split.

    Raises:
        DatasetError: One is not.
    """
    for row, dataset in product(rows, datasets):
        if (check := getattr(row, "check", None)) is not None:
            check(dataset, split)


MAX_TUNING_SAMPLES = 50
"""Validation samples on which the bench tunes thresholds, at most."""
CANDIDATES = {
    "probability": np.arange(0.05, 1.0, 0.05).round(4),
    "distance_m": np.arange(0.05, 0.85, 0.05).round(4),
}
"""The thresholds that are tried, by the field of `Thresholds`."""


def judged_by(prediction: Prediction) -> str:
    """The field of `Thresholds` that decides which voxels of a prediction are occupied."""
    return "distance_m" if prediction.occupancy_probability is None else "probability"


def ious_by_threshold(prediction: Prediction, truth: Mask, scored: Mask) -> Floats:
    """IoU at every candidate of the prediction's threshold, from one histogram.

    Args:
        prediction: Of one map, of shape (*grid.shape).
        truth: Occupied voxels (*grid.shape).
        scored: The voxels (*grid.shape) that count.

    Returns:
        (candidates,): `lidarsim.grid.iou` of ``prediction.occupied(thresholds)`` and the truth.
    """
    name = judged_by(prediction)
    edges = CANDIDATES[name].astype(np.float32)  # as `Prediction.occupied` compares
    by_probability = name == "probability"
    values = plain(prediction.occupancy_probability if by_probability else prediction.tudf)
    values = values.astype(np.result_type(values, np.float32))  # halves and bits, too
    counts = np.zeros((2, len(edges) + 1), np.int64)
    grids = [np.ascontiguousarray(grid).reshape(-1) for grid in (values, truth, scored)]
    _count(*grids, edges, not by_probability, counts)  # type: ignore[call-arg]
    alarms, hits = counts.cumsum(axis=1)[:, :-1]  # of voxels that pass at most n edges, for edge n
    free, occupied = counts.sum(axis=1)
    if by_probability:
        alarms, hits = free - alarms, occupied - hits
    union = alarms + occupied
    return np.where(union, hits / np.maximum(union, 1), 1.0)


@kernel
def _count(values, truth, scored, edges, ties, counts):
    """Count the scored voxels (voxels,) by the truth and by how many `edges` their value exceeds,
    or, with `ties`, reaches."""
    for v in range(len(values)):
        if scored[v]:
            passed = 0
            while passed < len(edges) and (
                edges[passed] < values[v] or (ties and edges[passed] == values[v])
            ):
                passed += 1
            counts[1 if truth[v] else 0, passed] += 1


def best_of(name: str, ious: Floats, usual: Thresholds) -> Thresholds:
    """Choose the threshold of the largest mean IoU, the first of equal ones.

    Args:
        name: Field of `Thresholds`.
        ious: Mean IoU of each candidate, (candidates,).
        usual: The other thresholds; returned if all candidates are equal.

    Returns:
        `usual` with the chosen threshold in place of its own.
    """
    # such as predictions of 0 and 1 only, on which no threshold is better than the usual one
    if np.ptp(ious) < 1e-12:
        return usual
    return replace(usual, **{name: float(CANDIDATES[name][int(ious.argmax())])})


def tune(method: Method, dataset: AnyDataset, thresholds: Thresholds) -> Thresholds:
    """Find the thresholds at which a method has the largest mean IoU on validation samples.

    At most `MAX_TUNING_SAMPLES` are completed, evenly spread: the same rule for every method.

    Args:
        method: The method.
        dataset: The dataset.
        thresholds: The usual ones.

    Returns:
        The tuned thresholds; `thresholds` if all do equally well, or the method predicts nothing of
        the validation split.
    """
    split = dataset.split("val")
    rows, name = [], ""
    # on val, so that no method is tuned on the maps that it is then judged by
    for index in evenly(len(split), MAX_TUNING_SAMPLES) if len(split) else ():
        sample = split[index]
        try:
            (completion,) = answers(method, sample, split, 0, index, draws=1)
        except KeyError:  # a file that predicts only the test split
            return thresholds
        name = judged_by(completion)
        scored = scored_voxels(sample, dataset.grid, split.home(index).tables.world)
        rows.append(ious_by_threshold(completion, sample.occupancy, scored))
    return best_of(name, np.mean(rows, axis=0), thresholds) if rows else thresholds
