"""A sample as it is drawn, read as far as its dataset is sound."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim import Sensor
from lidarsim.grid import Field, Floats, GridSpec, Mask, iou
from scenegen import SPLITS
from scenegen.base.errors import DatasetError, ScenegenError, printable
from scenegen.dataset.collection import open_data
from scenegen.dataset.read import AnyDataset, Split
from scenegen.draw.sample import Sample
from scenegen.draw.scored import certain_distances, scored_voxels

MASKS = ("observed", "free", "occupancy")


@dataclass(frozen=True, eq=False, kw_only=True)
class Route:
    """A path that somebody planned, to be shown. Positions are metres in the world."""

    start: Floats
    """Where it begins (3,)."""
    goal: Floats
    """Where it is to lead (3,)."""
    points: Floats | None
    """The path (n, 3); None where none was found."""
    told: str
    """What came of it, in a few words."""
    hit: Floats | None = None
    """The centre of the first voxel in which it does (3,)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Guess:
    """What somebody predicts of a sample's map, to be shown beside the truth."""

    name: str
    occupied: Mask
    """Voxels, of the grid's shape."""
    tudf: Field | None
    """Distances, of the grid's shape, metres; None where none are predicted."""
    route: Route | None = None
    """The path that was planned on these maps."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Look:
    """A sample to be shown: what could be read of it. Lengths are metres, positions in the
    world."""

    name: str
    grid: GridSpec
    origin: Floats
    """The grid's least corner (3,)."""
    position: Floats
    """Where the sensor is (3,)."""
    quaternion: Floats
    """The body's attitude (4,), w, x, y, z."""
    masks: Mapping[str, Mask] = field(default_factory=dict)
    """Voxels to be shown by name, each of the grid's shape: observed, free, occupancy; a caller's
    own beside them."""
    tudf: Field | None = None
    """Distances, of the grid's shape."""
    scans: Sequence[Floats] = ()
    """Returns (M, 3) of each scan, its own first; none where they could not be read."""
    rays: int = 0
    """How many rays they have."""
    known: Mask | None = None
    """In a map of a real place, the voxels whose occupancy the map knows; None if all are known."""
    scored: Mask | None = None
    """The voxels that scores count, as in the bench: see `scored_voxels`. None for all."""
    guesses: tuple[Guess, ...] = ()
    """What was predicted of it."""
    missing: tuple[str, ...] = ()
    """A line for each thing that could not be read."""

    @property
    def corners(self) -> tuple[Floats, Floats]:
        """Least and greatest corner of the grid (3,)."""
        return self.origin, self.origin + self.grid.extent_m

    @property
    def points(self) -> Floats | None:
        """Returns (M, 3) of all scans."""
        return np.concatenate(self.scans) if self.scans else None

    @cached_property
    def certain(self) -> Mask | None:
        """The voxels whose true distance is certain, see `certain_distances`; None if all are, or
        there are no distances."""
        if self.tudf is None:
            return None
        return certain_distances(self.tudf, self.known, self.grid)

    def figures(self) -> dict[str, str]:
        """Statistics in words, by name."""
        shares = dict(self.masks)
        if {"observed", "free"} <= shares.keys():
            shares["unknown"] = ~(shares["observed"] | shares["free"])
        if self.known is not None:
            shares["known"] = self.known
        rows = {name: f"{100 * mask.mean():.2f} %" for name, mask in shares.items()}
        if self.known is not None and "occupancy" in shares and self.known.any():
            occupied = shares["occupancy"][self.known]
            rows["occupancy"] = f"{100 * occupied.mean():.2f} % of known voxels"
        if self.points is not None:
            several = f" in {len(self.scans)} scans" if len(self.scans) > 1 else ""
            rows["returns"] = f"{len(self.points)} of {self.rays} rays{several}"
            if len(own := self.scans[0]):
                ranges = np.linalg.norm(own - self.position, axis=1)
                rows["mean range"] = f"{ranges.mean():.2f} m"
        if self.tudf is not None:
            all_certain = self.certain is None
            certain = self.tudf.ravel() if all_certain else self.tudf[self.certain]
            if len(certain):
                where = "" if all_certain else " where certain"
                rows["mean distance"] = f"{certain.mean():.2f} m{where}"
        for guess in self.guesses:
            if (text := self.iou(guess)) and (truth := self.masks.get("occupancy")) is not None:
                wrong = (truth ^ guess.occupied) & (True if self.scored is None else self.scored)
                missed, invented = (wrong & truth).sum(), (wrong & guess.occupied).sum()
                rows[guess.name] = f"{text}, {missed} missed, {invented} invented"
            if guess.route is not None:
                rows[f"{guess.name}: path"] = guess.route.told
        return rows

    def iou(self, guess: Guess) -> str:
        """The intersection over union of a prediction over the voxels that scores count, in words;
        nothing without a truth."""
        if (truth := self.masks.get("occupancy")) is None:
            return ""
        scored = np.ones(truth.shape, bool) if self.scored is None else self.scored
        return f"IoU {iou(truth & scored, guess.occupied & scored):.3f}"

    def heading_deg(self) -> float:
        """Yaw of the body, degrees, counter-clockwise from x; rounded, so that it is the same on
        every processor."""
        w, x, y, z = self.quaternion
        return round(float(np.degrees(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))), 9)


def look_at(
    sample: Sample,
    grid: GridSpec,
    lidar: Sensor | None,
    name: str,
    world: Mapping[str, Any] | None = None,
) -> Look:
    """Reads a sample as far as that can be. `world` is its recipe's table, which tells where the
    ground is. Raises DatasetError where not even its pose can."""
    pose = {field: getattr(sample, field) for field in ("origin", "position", "quaternion")}
    if not all(np.isfinite(part).all() for part in pose.values()):
        raise DatasetError(f"{name}: its pose is not finite")
    missing: list[str] = []

    def read(field: str, find: Callable[[], Any]) -> Any:
        try:
            return find()
        except (DatasetError, ValueError) as error:
            missing.append(f"{name}: {field} is not shown: {printable(error)}")
            return None

    scans = read("the scan", lambda: sample.scans(lidar)) or ()
    masks = {field: read(field, partial(getattr, sample, field)) for field in MASKS}
    return Look(
        name=name,
        grid=grid,
        **pose,
        masks={field: mask for field, mask in masks.items() if mask is not None},
        tudf=read("tudf", lambda: sample.tudf),
        scans=[scan.points() for scan in scans],
        rays=sum(scan.ranges.size for scan in scans),
        known=read("known", lambda: sample.known),
        scored=read("what scores count", lambda: scored_voxels(sample, grid, world)),
        missing=tuple(missing),
    )


Guesses = Callable[[Split, int], Sequence[Guess]]
"""What is predicted of a split's sample, by its index. Raises ScenegenError for a sample of which
nothing is."""


def look_into(samples: Split, index: int, guesses: Guesses | None) -> Look:
    """Reads sample `index` of a split as far as that can be, with what `guesses` predicts of it.

    Raises:
        IndexError: The split has no such index.
        DatasetError: Nothing of the sample can be shown.
    """
    dataset, name = samples.dataset, f"{samples.name} {index}"
    try:
        home = samples.home(index)
        if home.graded != dataset.kind:  # the title does not tell it
            name += f", {home.graded}"
        look = look_at(samples[index], dataset.grid, home.lidar, name, home.tables.world)
    except DatasetError as error:
        raise DatasetError(f"{name} is not shown: {printable(error)}") from None
    if guesses is None:
        return look
    try:
        return replace(look, guesses=tuple(guesses(samples, index)))
    except ScenegenError as error:
        line = f"{name}: what is predicted is not shown: {printable(error)}"
        return replace(look, missing=(*look.missing, line))


def looks(
    dataset: AnyDataset, split: str, indices: Iterable[int], guesses: Guesses | None = None
) -> tuple[list[Look], list[str]]:
    """Reads samples of a split, with what `guesses` predicts of them.

    Returns:
        The samples, and a line for each thing that could not be read.

    Raises:
        DatasetError: The split has no such index, or none of the samples can be read.
    """
    samples, shown, notes = dataset.split(split), [], incomplete(dataset, split)
    for index in indices:
        try:
            shown.append(look_into(samples, index, guesses))
        except IndexError as error:
            raise DatasetError(f"{error}; expected --index below {len(samples)}") from None
        except DatasetError as error:
            notes.append(str(error))
    notes += [line for look in shown for line in look.missing]
    if not shown:
        raise DatasetError(notes[-1] if notes else f"{dataset.name}: its {split} split is empty")
    return shown, notes


def looks_of_dataset(path: Path, most: int = 24) -> list[Look]:
    """At most `most` samples of the first split that has any of a dataset, a collection or a
    selection, evenly spread. Raises DatasetError."""
    dataset = open_data(path, partial=True)
    split = next((name for name in SPLITS if len(dataset.split(name))), SPLITS[0])
    return looks(dataset, split, evenly(len(dataset.split(split)), most))[0]


def title_of(dataset: AnyDataset) -> str:
    """What a dataset is called in titles: its folder, and its kind where that says more."""
    folder, kind = Path(dataset.name).name, dataset.kind
    return printable(folder if folder == kind else f"{folder}: {kind}")


def incomplete(dataset: AnyDataset, split: str) -> list[str]:
    """A line for a dataset that is incomplete; none for another."""
    if all(one.manifest.complete for one in dataset.datasets):
        return []
    count = len(dataset.split(split))
    return [f"the dataset is incomplete: {count} samples of its {split} split are there"]


def evenly(count: int, most: int) -> list[int]:
    """At most `most` of the numbers below `count`, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).astype(int)).tolist()
