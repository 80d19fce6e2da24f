"""What the bench compares: completers, and the truth itself. `predicted` and `pretrained` hold
other rows."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from scenegen.dataset.read import Split
from scenegen.errors import printable
from scenegen.model.completion.protocol import (
    MapCompleter,
    Prediction,
    PredictionError,
    check_prediction,
)
from scenegen.sample import Sample


class Method(Protocol):
    """A row of the tables. Methods travel to worker processes."""

    @property
    def name(self) -> str:
        """How the method is called in tables."""
        ...

    @property
    def learned(self) -> bool:
        """Whether the method was trained, or may have been; not one that is only there to be
        compared with."""
        ...

    def completion(self, sample: Sample, split: Split) -> Prediction:
        """What the method says about the map of `sample`, which is one of `split`'s."""
        ...


@dataclass(frozen=True)
class Completed:
    """A completer, shown nothing but what was seen."""

    completer: MapCompleter

    def __post_init__(self) -> None:
        for what, held, wanted in (
            (
                "name",
                isinstance(getattr(self.completer, "name", None), str),
                "a string, how the tables call it",
            ),
            (
                "complete",
                callable(getattr(self.completer, "complete", None)),
                "a method: (observed, free, *, grid)",
            ),
        ):
            if not held:
                raise PredictionError(f"{type(self.completer).__name__}: lacks `{what}`, {wanted}")

    @property
    def name(self) -> str:
        """The completer's, in one line: a network's comes from its file's name."""
        return printable(self.completer.name)

    @property
    def learned(self) -> bool:
        """Whatever the completer says of itself; one that says nothing may be."""
        return bool(getattr(self.completer, "learned", True))

    def completion(self, sample: Sample, split: Split) -> Prediction:
        """See `Method.completion`. Raises PredictionError where the completer gives what is no
        prediction."""
        found = self.completer.complete(sample.observed, sample.free, grid=split.dataset.grid)
        return check_prediction(found, split.dataset.grid.shape, self.name)


@dataclass(frozen=True)
class Truth:
    """The truth as if it had been predicted: the ceiling, and what the planner itself loses."""

    name: str = "truth"
    learned: bool = False

    def completion(self, sample: Sample, split: Split) -> Prediction:
        """See `Method.completion`."""
        return Prediction(
            occupancy_probability=sample.occupancy.astype(np.float32)
        )  # whose transform is the distance
