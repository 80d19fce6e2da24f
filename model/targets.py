"""Targets of networks, by name.

A target defines its truth, the number of channels that a network has for it, the loss by which
these are learned, and the array of a prediction. One more is a class like those below: an entry of
`TARGETS` in config.py, or a user's own as module:Class, in the `NetworkConfig` of the network that
predicts it. The batch, the outputs of a network, its loss and its predictions call a target by its
`target_name`.
"""

from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from lidarsim.grid import GridSpec
from lidarsim.parameters import short_repr
from scenegen.base.errors import (
    DatasetError,
    MissingPartError,
    ScenegenError,
    check_int,
    own_code,
    reraise_as,
)
from scenegen.base.limits import MAX_CLASSES
from scenegen.draw.sample import Sample
from scenegen.model.config import HORIZONS, TARGETS, import_named, is_own, target_name
from scenegen.model.inputs import turned
from scenegen.truth import distance_field

if TYPE_CHECKING:
    from torch import Tensor

Terms = Mapping[str, "Tensor"]
"""Scalars of a loss, by name."""


class Target:
    """Something that a network predicts of every voxel. A user's own is a subclass with a `truth`
    and a `loss`."""

    channels: int | Callable[[Mapping[str, Any]], int | Sequence[str]] = 1
    """Values a voxel that the network gives. Or a method: the settings of a dataset's parts (such
    as its ``labels``) -> this number, or a name for each, which all datasets must agree on."""
    part = ""
    """The array of a prediction that holds it, where that is not called like the target."""
    meaning = "finite numbers"
    """Meaning of a prediction's values, for errors."""
    minimum = -np.inf
    """The least value of a prediction."""
    maximum = np.inf
    """The greatest value of a prediction."""
    metrics: ClassVar[Mapping[str, Any]] = {}
    """Metrics of its own by name, for the bench and validation: each a function of a
    `scenegen.model.bench.metrics.ScoredMap`, or a `Metric` in the same module."""

    @abstractmethod
    def truth(self, sample: Sample, grid: GridSpec) -> NDArray[Any]:
        """Compute the true map.

        Args:
            sample: The sample.
            grid: Its grid.

        Returns:
            (*grid.shape) or (channels, *grid.shape), of a type that torch has.
        """

    def turned(self, truth: NDArray[Any], symmetry: int) -> NDArray[Any]:
        """Turn the truth with its map. Override it if the values are directions.

        Args:
            truth: The truth.
            symmetry: See `scenegen.model.inputs.turned`.

        Returns:
            The turned truth.
        """
        return turned(truth, symmetry)

    def output(self, values: "Tensor") -> "Tensor":
        """Apply the activation to the values of a head, (B, *grid.shape) or (B, channels,
        *grid.shape)."""
        return values

    @abstractmethod
    def loss(
        self, output: "Tensor", batch: Mapping[str, "Tensor"], objective: Any
    ) -> "Tensor | tuple[Tensor, Terms]":
        """Compute the target's part of the loss of a batch.

        Args:
            output: The network's, as the method `output` made it.
            batch: The inputs and the truth by name; of maps of real places, `known`, too.
            objective: A `scenegen.model.losses.Coupled`; it has the `config`, the `grid`, and
                `mean(values, over)`.

        Returns:
            A scalar, which is added to the loss; with its terms by name, if it has several.
        """

    def prediction(self, output: "Tensor", grid: GridSpec) -> "Tensor":
        """Make an output into the array that a prediction holds.

        Args:
            output: From the method `output`.
            grid: The grid.

        Returns:
            (B, *grid.shape) or (B, channels, *grid.shape).
        """
        return output


class Occupancy(Target):
    """Occupancy of a voxel; outputs are logits."""

    part, meaning, minimum, maximum = "occupancy_probability", "a probability from 0 to 1", 0.0, 1.0
    end = ""
    """End of the names of its truth and of its terms."""

    def truth(self, sample: Sample, grid: GridSpec) -> NDArray[Any]:
        """Return the true occupancy.

        Args:
            sample: The sample.
            grid: Its grid.

        Returns:
            Mask (*grid.shape).
        """
        return sample.occupancy

    def loss(
        self, output: "Tensor", batch: Mapping[str, "Tensor"], objective: Any
    ) -> "tuple[Tensor, Terms]":
        """Eq. 8 and the Lovász hinge, weighted; see `Target.loss`.

        Args:
            output: Logits.
            batch: Holds the truth, and maybe `known`.
            objective: See `Target.loss`.

        Returns:
            The weighted sum, and its terms without weights.
        """
        config, name = objective.config, f"occupancy{self.end}"
        truth = batch[name], batch.get("known")
        terms = {name: objective.occupancy_loss(output, *truth)}
        total = terms[name]
        if config.lovasz:
            lovasz = terms[f"lovasz{self.end}"] = objective.lovasz_loss(output, *truth)
            total = total + config.lovasz * lovasz
        return config.occupancy * total, terms

    def prediction(self, output: "Tensor", grid: GridSpec) -> "Tensor":
        """Convert logits to probabilities.

        Args:
            output: Logits.
            grid: The grid; not used.

        Returns:
            From 0 to 1, of the same shape.
        """
        return output.sigmoid()


class Tudf(Target):
    """The distance to the nearest occupied voxel's centre, metres."""

    part, meaning, minimum = "tudf", "a distance of at least 0", 0.0

    def truth(self, sample: Sample, grid: GridSpec) -> NDArray[Any]:
        """Compute the true distances.

        Args:
            sample: The sample.
            grid: Its grid.

        Returns:
            (*grid.shape): float32 metres, truncated.
        """
        # from the occupancy, even if the dataset stores distances: that spares reading them
        return distance_field(sample.occupancy, grid)

    def output(self, values: "Tensor") -> "Tensor":
        """Make distances that are not negative. They are not truncated."""
        # truncated here, outputs beyond the truncation would have no gradient
        from torch.nn.functional import softplus

        return softplus(values)

    def loss(
        self, output: "Tensor", batch: Mapping[str, "Tensor"], objective: Any
    ) -> "tuple[Tensor, Terms]":
        """Eq. 9 and 10, weighted; see `Target.loss`.

        Args:
            output: Distances, metres.
            batch: Holds `tudf`, and maybe `certain`.
            objective: See `Target.loss`.

        Returns:
            The weighted sum, and its terms without weights.
        """
        config, truth = objective.config, (batch["tudf"], batch.get("certain"))
        terms = {"regression": objective.regression_loss(output, *truth)}
        total = terms["regression"]
        if config.eikonal:  # a tenth of a step's time
            terms["eikonal"] = objective.eikonal_loss(output, *truth)
            total = total + config.eikonal * terms["eikonal"]
        return config.tudf * total, terms

    def prediction(self, output: "Tensor", grid: GridSpec) -> "Tensor":
        """Truncate distances as the truth is.

        Args:
            output: Distances, metres.
            grid: The grid.

        Returns:
            Distances of the same shape, at most the truncation.
        """
        return output.clamp(max=grid.truncation_m)


@cache
def target_called(name: str) -> Target:
    """Make a target. A user's own class is imported now.

    Args:
        name: Its name.

    Returns:
        The target, the same object on every call.

    Raises:
        ScenegenError: There is no such target, or it is something else.
    """
    kind = import_named(TARGETS, name)
    with reraise_as(ScenegenError, f"target {name}: cannot be made: ", of=TypeError):
        target: Target = kind(HORIZONS[name]) if name in HORIZONS else kind()
    if not isinstance(target, Target):
        raise ScenegenError(f"target {name}: expected a subclass of scenegen.model.targets.Target")
    return target


def targets_of(names: Iterable[str]) -> dict[str, Target]:
    """Make targets.

    Args:
        names: Names of targets that come with scenegen, or module:Class.

    Returns:
        Targets by `target_name`: occupancy first, then distances, then a user's own.
    """
    targets = {target_name(name): target_called(name) for name in names}
    return {name: targets[name] for name in (*BUILT_IN, *targets) if name in targets}


def true_map(name: str, sample: Sample, grid: GridSpec) -> NDArray[Any]:
    """Compute the truth of a target. That of a user's own is checked.

    Args:
        name: Name of the target.
        sample: The sample.
        grid: Its grid.

    Returns:
        (*grid.shape) or (channels, *grid.shape).

    Raises:
        DatasetError: It is not a map of numbers.
    """
    target = target_called(name)
    return truth_of(target, name, sample, grid) if is_own(name) else target.truth(sample, grid)


def truth_of(target: Target, name: str, sample: Sample, grid: GridSpec) -> NDArray[Any]:
    """Compute the truth of a user's own target, and check it.

    Args:
        target: The target.
        name: Its name in errors.
        sample: The sample.
        grid: Its grid.

    Returns:
        The true map, (*grid.shape) or (channels, *grid.shape).

    Raises:
        MissingPartError: It needs a part of samples that the dataset lacks.
        DatasetError: It is not a map of numbers.
        OwnCodeError: The target's code failed.
    """
    fault: Exception
    try:
        with own_code(f"target {name}: expected a method truth(sample, grid)"):
            truth = np.asarray(target.truth(sample, grid))
    except MissingPartError:
        raise
    except Exception as error:  # a loader process hands over no traceback
        fault = error
    else:
        if truth.shape[-3:] == grid.shape and truth.ndim <= 4 and truth.dtype.kind in "fiub":
            return truth
        fault = DatasetError(
            f"target {name}: gives an array of {truth.dtype} of shape {truth.shape}, expected "
            f"numbers of shape {grid.shape}"
        )
    # again, to see which fields it reads: without these, its fault is most likely the dataset's
    watched = _WatchedSample(sample)
    with suppress(Exception):
        target.truth(watched, grid)  # type: ignore[arg-type]
    if watched.absent:
        field = next(iter(watched.absent))
        raise MissingPartError(
            f"target {name}: needs {field}, which only datasets {WITH[watched.absent[field]]} "
            f"have ({fault})"
        )
    raise fault


def turned_truth(name: str, truth: NDArray[Any], symmetry: int) -> NDArray[Any]:
    """Turn the truth of a target with its map; see `Target.turned`.

    Args:
        name: Name of the target.
        truth: The truth.
        symmetry: See `scenegen.model.inputs.turned`.

    Returns:
        The turned truth, contiguous, of the same shape.

    Raises:
        DatasetError: It has another shape.
        OwnCodeError: The target's code failed.
    """
    who = f"target {name}: turned(truth, symmetry)"
    with own_code(f"{who} fails"):
        turned_map = np.ascontiguousarray(target_called(name).turned(truth, symmetry))
    if turned_map.shape != truth.shape or turned_map.dtype.kind not in "fiub":
        raise DatasetError(
            f"{who} gives an array of {turned_map.dtype} of shape {turned_map.shape}, expected "
            f"numbers of shape {truth.shape}"
        )
    return turned_map


WITH = {
    "labels": "made with --labels",
    "normals": "made with --normals",
    "earlier": "with several scans a sample",
    "known": "of maps of real places",
}
"""Which datasets have the fields of a sample's group."""


class _WatchedSample:
    """A sample that notes which fields its dataset lacks among those that are read."""

    def __init__(self, sample: Sample):
        self._sample = sample
        self.absent = dict[str, str]()
        """Group of each such field."""

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._sample, name)
        if value is None and name in GROUPS:
            self.absent[name] = GROUPS[name]
        return value


GROUPS = {
    item.name: item.metadata["group"] for item in fields(Sample) if item.metadata.get("group")
}


def channels_of(name: str, parts: Sequence[Mapping[str, Any]]) -> int:
    """Determine how many channels a target has.

    Args:
        name: Name of the target.
        parts: Settings of the samples' parts of each dataset.

    Returns:
        The number.

    Raises:
        DatasetError: The datasets do not agree, or lack a part that the target needs; or it is no
            number from 1 to `MAX_CLASSES`.
    """
    channels = target_called(name).channels
    label = f"target {name}: channels"
    if not callable(channels):
        return check_int(label, channels, 1, MAX_CLASSES)
    try:
        first, *further = [channels(settings) for settings in parts]
    except Exception as error:
        line = f"{type(error).__name__}: {short_repr(str(error))}"
        raise DatasetError(
            f"target {name}: finds no number of channels in the dataset's parts ({line}); is it "
            "one with --labels?"
        ) from None
    # names are compared, too: of two datasets, channel 3 must be the same class
    if any(channel != first for channel in further):
        raise DatasetError(
            f"target {name}: datasets differ in its channels, {short_repr(first)} and "
            f"{short_repr(next(channel for channel in further if channel != first))}; train on "
            "datasets that "
            "share them"
        )
    if isinstance(first, Sequence) and not isinstance(first, str):
        first = len(first)
    return check_int(label, first, 1, MAX_CLASSES)


BUILT_IN: dict[str, Target] = {"occupancy": Occupancy(), "tudf": Tudf()}
"""Occupancy and distances: every batch has their truth, and planning needs nothing else."""
