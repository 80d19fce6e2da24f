"""Predictions, the protocol of methods that complete maps, and the methods without learning, which
a network has to beat.

A method sees the observations of a map and predicts its occupancy, its distances, or both. The
missing one is derived as the paper does for its single-task networks: distances by the transform of
the predicted occupancy, occupancy by a threshold on the distance.
"""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
from scipy import ndimage

from lidarsim.grid import Field, GridSpec, Mask
from scenegen.base.errors import ScenegenError
from scenegen.draw.sample import html_table
from scenegen.model.calibration import Calibration, StoredProbability, away_of, denial
from scenegen.model.config import Thresholds
from scenegen.model.inputs import SeenMap
from scenegen.model.targets import BUILT_IN, Target
from scenegen.truth import distance_field


@dataclass(frozen=True, eq=False, repr=False)
class Prediction:
    """Prediction of a map, or of a batch of them: a probability of occupancy, a distance, or both.

    Raises:
        ValueError: if it has neither.
    """

    occupancy_probability: Any = None
    """float32 (*shape), numpy or torch: the probability of being occupied, from 0 to 1."""
    tudf: Any = None
    """float32 (*shape), numpy or torch: distance to the nearest occupied voxel's centre, metres."""
    calibration: Calibration | StoredProbability | None = None
    """Source of calibrated probabilities; None for a network that was not calibrated."""
    observed: Any = None
    """(*shape), numpy or torch: where a return lies, by which `calibration` tells unfamiliar maps
    from others; None if unknown."""
    others: Mapping[str, Any] = field(default_factory=dict)
    """Predictions of other targets by `target_name`: (*shape), or (channels, X, Y, Z) a map."""

    def __post_init__(self) -> None:
        if self.occupancy_probability is None and self.tudf is None:
            raise ValueError("a completion needs a probability of occupancy, a distance, or both")

    def __repr__(self) -> str:
        parts = [name for name in PARTS if getattr(self, name) is not None]
        names = ", ".join((*parts, *self.others))
        return f"<Prediction: {names} {tuple(getattr(self, parts[0]).shape)}>"

    @classmethod
    def of(cls, arrays: Mapping[str, Any], **fields: Any) -> "Prediction":
        """Make a prediction from arrays.

        Args:
            arrays: Arrays by name: `PARTS`, and those of other targets.
            fields: Other fields.

        Returns:
            The prediction.
        """
        parts = {name: arrays[name] for name in PARTS if name in arrays}
        others = {name: values for name, values in arrays.items() if name not in PARTS}
        return cls(**parts, **fields, others=others)

    def arrays(self) -> dict[str, Any]:
        """Return the arrays that a file holds, by name: those of `STORED` as float32, and those of
        other targets."""
        stored = {name: plain(getattr(self, name)) for name in STORED}
        arrays = {n: v.astype(np.float32) for n, v in stored.items() if v is not None}
        return arrays | {name: plain(values) for name, values in self.others.items()}

    def _repr_html_(self) -> str:
        """Make a table for notebooks: the least, mean and greatest number of each part."""
        rows: list[tuple[str, ...]] = [("", "", "least", "mean", "greatest")]
        parts = {name: getattr(self, name) for name in PARTS} | dict(self.others)
        for name, part in parts.items():
            target = PARTS.get(name, Target)
            if (values := plain(part)) is not None:
                figures = (values.min(), values.mean(), values.max())
                rows.append((name, target.meaning, *(f"{figure:.3g}" for figure in figures)))
        return html_table(rows, self)

    def occupied(self, thresholds: Thresholds | None = None) -> Mask:
        """Return the binary map, (*shape).

        A voxel is occupied if its probability is greater than the threshold ("greater than" in the
        paper's section "Implementation Details"); without probabilities, if its distance is less
        than the threshold of distances.

        Args:
            thresholds: The thresholds; by default the paper's.
        """
        thresholds = thresholds or Thresholds()
        if self.occupancy_probability is not None:
            return self.occupancy_probability > np.float32(thresholds.probability)

        return self.tudf < np.float32(thresholds.distance_m)

    def distance(self, thresholds: Thresholds | None, grid: GridSpec) -> Field:
        """Return the distance field.

        Args:
            thresholds: Thresholds of occupancy, whose transform replaces missing distances; None:
                the paper's.
            grid: The grid.

        Returns:
            (*shape): metres, at most the truncation.
        """
        # a method may predict more than the truncation, which the truth never has
        if self.tudf is not None:
            return np.minimum(self.tudf, np.float32(grid.truncation_m))
        return distance_field(self.occupied(thresholds), grid)

    @property
    def probability(self) -> Any:
        """Calibrated probability of being occupied, float32 (*shape), numpy or torch; None without
        a calibration. The paper's thresholds are for `occupancy_probability`, not for this."""
        if self.calibration is None:
            return None
        return self._as_given(self.calibration.chance(plain(self.occupancy_probability), self.away))

    @property
    def chance(self) -> Any:
        """Probability of being occupied as viewers show it, numpy (*shape): calibrated if possible,
        else the network's own; None if only distances are predicted."""
        calibrated = plain(self.probability)
        return plain(self.occupancy_probability) if calibrated is None else calibrated

    @property
    def away(self) -> Any:
        """How unfamiliar the map is, or each of a batch, from 0 to 1; None if not measured.

        In an unfamiliar place a network often calls voxels free that hold a return. The value is
        the share of the calibration's maps on which it did so less often. From 0.95 on, expect a
        worse completion; a lower value is no promise of a good one.
        """
        probability, observed = plain(self.occupancy_probability), plain(self.observed)
        known = self.calibration
        if observed is None or not isinstance(known, Calibration) or not known.denied:
            return None
        denied = denial(probability, observed.astype(bool), known.class_weight)
        return away_of(denied, known.denied)

    def _as_given(self, values: Field | None) -> Any:
        """Convert to torch, on the device of the predictions, if these are torch."""
        like = self.occupancy_probability if self.tudf is None else self.tudf
        return values if values is None or isinstance(like, np.ndarray) else like.new_tensor(values)


def plain(values: Any) -> Any:
    """Convert numpy or torch to numpy; None stays None."""
    return values if values is None or isinstance(values, np.ndarray) else values.numpy(force=True)


class PredictionError(ScenegenError):
    """Error of a method whose answer is not a valid prediction."""


PARTS = {target.part: target for target in BUILT_IN.values()}
"""Parts of a prediction that every method may give, with their targets."""
STORED = *PARTS, "probability"
"""Arrays that a file of predictions may hold."""


def check_prediction(
    answer: Any,
    shape: tuple[int, ...],
    who: str,
    targets: Mapping[str, Target | type[Target]] = BUILT_IN,
) -> Prediction:
    """Check that a method gave a prediction.

    Every number is finite, probabilities lie in [0, 1], and no distance is negative; distances
    beyond the truncation are allowed.

    Args:
        answer: The method's answer.
        shape: Shape of its numpy or torch arrays; those of other targets may have channels before
            x.
        who: The method's name, for errors.
        targets: Targets by name, whose bounds predictions keep.

    Returns:
        `answer`.

    Raises:
        PredictionError: It is not a `Prediction`, or holds an array of another shape or type, or
            numbers out of bounds.
    """
    if not isinstance(answer, Prediction):
        raise PredictionError(
            f"{who}: gives {type(answer).__name__}, expected a "
            f"scenegen.model.completion.protocol.Prediction"
        )
    parts = {name: getattr(answer, name) for name in PARTS} | dict(answer.others)
    if isinstance(answer.calibration, StoredProbability):  # one computed here needs no check
        parts["probability"] = answer.calibration.probability
    for name, values in parts.items():
        if values is None and name not in answer.others:
            continue
        target = BUILT_IN["occupancy"] if name == "probability" else PARTS.get(name, Target)
        target = targets.get(name, target)
        array_shape = tuple(getattr(values, "shape", ()))
        if name in answer.others and len(array_shape) == len(shape) + 1:  # which has channels
            array_shape = (*array_shape[:-4], *array_shape[-3:])
        if array_shape != tuple(shape):
            held = (
                f"an array of shape {tuple(values.shape)}"
                if hasattr(values, "shape")
                else type(values).__name__
            )
            raise PredictionError(
                f"{who}: {name} is {held}, expected an array of shape {tuple(shape)}"
            )
        if isinstance(values, np.ndarray) and values.dtype.kind not in "fiub":
            raise PredictionError(f"{who}: {name} holds {values.dtype}, expected float32")
        low, high = float(values.min()), float(values.max())  # NaN, if any voxel holds it
        if not (
            target.minimum <= low and high <= target.maximum and np.isfinite([low, high]).all()
        ):
            wrong = low if low < target.minimum else high
            held = f"{wrong:g}" if np.isfinite(wrong) else "NaN or infinity"
            raise PredictionError(
                f"{who}: {name} holds {held}, expected {target.meaning} in every voxel"
            )
    return answer


class MapCompleter(Protocol):
    """Anything that completes a map. A method of your own is a class with these two.

    Its `complete` may have two arguments more, which are given only to those that name them:
    ``seen``, a `SeenMap`, which also says where the map and the sensor are; and ``rng``, a NumPy
    Generator, of a method that draws its answers. A method that remembers has a method ``reset()``,
    too: a flight begins, or a map that has nothing to do with the last one.
    """

    name: str
    """How the method is called in tables."""

    def complete(self, observed: Mask, free: Mask, *, grid: GridSpec) -> Prediction:
        """Complete one map.

        Args:
            observed: Voxels that hold a return (*grid.shape).
            free: Voxels that a ray crossed (*grid.shape).
            grid: The grid.

        Returns:
            The prediction, arrays (*grid.shape).
        """
        ...


def extras_of(completer: Any) -> set[str]:
    """Return which of ``seen`` and ``rng`` the `complete` of a method takes."""
    method = completer.complete
    return {"seen", "rng"} & _parameters(getattr(method, "__func__", method))


@lru_cache(maxsize=64)
def _parameters(function: Callable[..., Any]) -> frozenset[str]:
    """The names of a function's parameters, which take a robot longer than a simple completion."""
    return frozenset(inspect.signature(function).parameters)


def complete_seen(
    completer: Any, seen: SeenMap, *, grid: GridSpec, rng: np.random.Generator | None = None
) -> Prediction:
    """Let a method complete a map.

    Args:
        completer: A `MapCompleter`.
        seen: The map.
        grid: Its grid.
        rng: Random numbers of a method that draws; by default, those of seed 0.

    Returns:
        The prediction, not checked.
    """
    # a method of two arguments stays as simple as it can be: it never sees the others
    extras = {"seen": seen, "rng": rng or np.random.default_rng(0)}
    chosen = {name: extras[name] for name in extras_of(completer)}
    return completer.complete(seen.observed, seen.free, grid=grid, **chosen)


def forget(completer: Any) -> None:
    """Reset a method that remembers; others have nothing to reset."""
    if (reset := getattr(completer, "reset", None)) is not None:
        reset()


UPRIGHT = np.zeros((3, 3, 3), bool)
UPRIGHT[1, 1] = True
"""A voxel's neighbours in its column."""


class ReturnsCompleter:
    """Occupied where something returned, free elsewhere. A robot that trusts its map as it is flies
    by this."""

    name = "returns"
    learned = False

    def complete(self, observed: Mask, free: Mask, *, grid: GridSpec) -> Prediction:
        """See `MapCompleter.complete`.

        Args:
            observed: Voxels that hold a return (*grid.shape).
            free: Voxels that a ray crossed (*grid.shape).
            grid: The grid.

        Returns:
            Probabilities: 1 where something returned, 0 elsewhere.
        """
        return Prediction(occupancy_probability=observed.astype(np.float32))


class Empty:
    """Free everywhere, every distance at the truncation: how much success needs no map."""

    name = "empty"
    learned = False

    def complete(self, observed: Mask, free: Mask, *, grid: GridSpec) -> Prediction:
        """See `MapCompleter.complete`.

        Args:
            observed: Voxels that hold a return (*grid.shape).
            free: Voxels that a ray crossed (*grid.shape).
            grid: The grid.

        Returns:
            Probabilities: 0 everywhere.
        """
        return Prediction(occupancy_probability=np.zeros(observed.shape, np.float32))


class Conservative:
    """Occupied wherever no ray crossed. A robot that trusts nothing unseen flies by this."""

    name = "conservative"
    learned = False

    def complete(self, observed: Mask, free: Mask, *, grid: GridSpec) -> Prediction:
        """See `MapCompleter.complete`.

        Args:
            observed: Voxels that hold a return (*grid.shape).
            free: Voxels that a ray crossed (*grid.shape).
            grid: The grid.

        Returns:
            Probabilities: 0 where a ray crossed, 1 elsewhere.
        """
        return Prediction(occupancy_probability=(~free).astype(np.float32))


class Extrude:
    """Returns, extended up and down their columns through unknown voxels until a free one. Networks
    for pillars have to beat this."""

    name = "extrude"
    learned = False

    def complete(self, observed: Mask, free: Mask, *, grid: GridSpec) -> Prediction:
        """See `MapCompleter.complete`.

        Args:
            observed: Voxels that hold a return (*grid.shape).
            free: Voxels that a ray crossed (*grid.shape).
            grid: The grid.

        Returns:
            Probabilities: 1 in the runs of unknown voxels that hold a return, 0 elsewhere.
        """
        # a run is unbroken by free voxels in its column; one with a return is occupied as a whole
        runs, count = ndimage.label(~free, UPRIGHT)
        met = np.zeros(count + 1, np.float32)
        met[runs[observed & ~free]] = 1.0
        return Prediction(occupancy_probability=met[runs])
