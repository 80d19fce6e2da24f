"""Reads samples for display, as far as they are not damaged."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim import Sensor
from lidarsim.grid import Field, Floats, GridSpec, Mask, iou
from lidarsim.movers import Movers
from scenegen import SPLITS
from scenegen.base.errors import DatasetError, ScenegenError, printable
from scenegen.base.files import Json
from scenegen.dataset.collection import open_data
from scenegen.dataset.read import INCOMPLETE, AnyDataset, Split
from scenegen.draw.sample import Sample
from scenegen.draw.scored import certain_distances, scored_voxels

MASKS = ("observed", "free", "occupancy")


@dataclass(frozen=True, eq=False, kw_only=True)
class PlannedPath:
    """A planned path. Positions are metres in the world."""

    start: Floats
    """Start (3,)."""
    goal: Floats
    """Goal (3,)."""
    points: Floats | None
    """The path (n, 3); None if no path was found."""
    told: str
    """Result in a few words, such as its length or its collision."""
    hit: Floats | None = None
    """Centre of the first voxel in which the path collides (3,); None if it does not."""
    flown: int = 0
    """Number of its points that were flown; the others are planned."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Guess:
    """A method's prediction of a sample's map."""

    name: str
    """Name of the method."""
    occupied: Mask
    """Occupied voxels, of the grid's shape."""
    tudf: Field | None
    """Distances, of the grid's shape, metres; None if the method predicts none."""
    route: PlannedPath | None = None
    """The path planned on these maps."""
    figures: Mapping[str, str] = field(default_factory=dict)
    """Its metrics of other targets, by name."""
    chance: Field | None = None
    """Probability of each voxel to be occupied, of the grid's shape; None if none is predicted."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Timeline:
    """Movers, and when they are shown: from the earliest of `scan_times` to `end_s`."""

    movers: Movers
    """What moves. Its times are seconds on the clock of `scan_times`."""
    scan_times: Floats
    """When each scan began (K,), the sample's own first; (0.0,) for a world."""
    end_s: float
    """Until when courses are known."""
    standing: Mask | None = None
    """Voxels of solids that stand, of the grid's shape; None: all that are occupied."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Look:
    """A sample for display, as far as it could be read. Lengths are metres, positions in the
    world."""

    name: str
    """Name of the sample, for titles."""
    grid: GridSpec
    """Grid of its map."""
    origin: Floats
    """The grid's lower corner (3,)."""
    position: Floats
    """Position of the sensor (3,)."""
    quaternion: Floats
    """Attitude of the body (4,), w, x, y, z."""
    masks: Mapping[str, Mask] = field(default_factory=dict)
    """Voxels by name, each of the grid's shape: observed, free, occupancy, and a caller's own."""
    tudf: Field | None = None
    """True distances, of the grid's shape."""
    scans: Sequence[Floats] = ()
    """Returns (M, 3) of each scan, the sample's own first; empty if they could not be read."""
    rays: int = 0
    """Number of rays of all scans."""
    known: Mask | None = None
    """Voxels whose occupancy the map of a real place knows; None if all are known."""
    scored: Mask | None = None
    """Voxels that scores count, see `scored_voxels`; None for all."""
    guesses: tuple[Guess, ...] = ()
    """Predictions of its map."""
    surfaces: Sequence[Any] = ()
    """Meshes of solids with `triangles` (n, 3, 3), metres in the world."""
    fov_deg: Sequence[float] | None = None
    """See `field_of_view`; None if the sensor is not known."""
    classes: tuple[NDArray[np.uint16], tuple[str, ...]] | None = None
    """True class of each voxel, of the grid's shape, and names of classes; None if unlabelled."""
    film: Json | None = None
    """Curves and ends of the flight that this is a picture of, see `scenegen.model.robots.film`."""
    timeline: Timeline | None = None
    """What moves; None without movers."""
    missing: tuple[str, ...] = ()
    """A line for each part that could not be read."""

    @property
    def corners(self) -> tuple[Floats, Floats]:
        """Lower and upper corner of the grid (3,)."""
        return self.origin, self.origin + self.grid.extent_m

    @property
    def has_sensor(self) -> bool:
        """Whether something was scanned, and not a world or a map alone is shown."""
        # what is observed was scanned, even if the scan itself could not be read
        return self.rays > 0 or (not self.scans and "observed" in self.masks)

    @property
    def points(self) -> Floats | None:
        """Returns (M, 3) of all scans; None without scans."""
        return np.concatenate(self.scans) if self.scans else None

    @cached_property
    def certain(self) -> Mask | None:
        """Voxels whose true distance is certain, see `certain_distances`; None for all, or if there
        are no distances."""
        if self.tudf is None:
            return None
        return certain_distances(self.tudf, self.known, self.grid)

    def figures(self) -> dict[str, str]:
        """Return statistics of the sample and its predictions, as texts by name."""
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
            of_rays = f" of {self.rays} rays" if self.rays else ""
            rows["returns"] = f"{len(self.points)}{of_rays}{several}"
            # ranges from this pose only: earlier scans were taken elsewhere
            if self.rays and len(first_scan := self.scans[0]):
                ranges = np.linalg.norm(first_scan - self.position, axis=1)
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
            rows |= {f"{guess.name}: {name}": text for name, text in guess.figures.items()}
            if guess.route is not None:
                rows[f"{guess.name}: path"] = guess.route.told
        return rows

    def iou(self, guess: Guess) -> str:
        """Return the IoU of a prediction over the scored voxels, as a text; "" without a truth."""
        if (truth := self.masks.get("occupancy")) is None:
            return ""
        scored = np.ones(truth.shape, bool) if self.scored is None else self.scored
        return f"IoU {iou(truth & scored, guess.occupied & scored):.3f}"


def field_of_view(sensor: Sensor) -> list[float]:
    """Return the directions between which a sensor's rays lie in the frame of its body, degrees.

    Args:
        sensor: The sensor.

    Returns:
        Least and greatest azimuth, counter-clockwise from forward, and least and greatest
        elevation.
    """
    x, y, z = np.moveaxis(sensor.directions_body, -1, 0)
    # rounding can lead z beyond 1, where the arcsine is NaN
    azimuth, elevation = np.arctan2(y, x), np.arcsin(np.clip(z, -1, 1))
    edges = [azimuth.min(), azimuth.max(), elevation.min(), elevation.max()]
    # rounded, so that pages are the same on every processor
    return np.degrees(edges).round(2).tolist()


def look_at(
    sample: Sample,
    grid: GridSpec,
    lidar: Sensor | None,
    name: str,
    world: Mapping[str, Any] | None = None,
    classes: tuple[str, ...] = (),
) -> Look:
    """Read a sample for display; parts that cannot be read are missing.

    Args:
        sample: The sample.
        grid: Grid of its map.
        lidar: Its sensor; None: of the sample's stream.
        name: Name for titles and errors.
        world: The recipe's table of the world, which has the height of the ground.
        classes: Names of the classes of a labelled dataset.

    Raises:
        DatasetError: Not even the pose can be read.
    """
    # nothing can be placed without a pose: a damaged one is an error, not a note
    pose = {field: getattr(sample, field) for field in ("origin", "position", "quaternion")}
    if not all(np.isfinite(part).all() for part in pose.values()):
        raise DatasetError(f"{name}: its pose is not finite")
    missing: list[str] = []

    # a damaged part must not hide the others: they may show what is wrong
    def read_part(field: str, find: Callable[[], Any]) -> Any:
        """Read a part, or note why it is missing.

        Args:
            field: Name of the part, for the note.
            find: Function that reads it.

        Returns:
            The part; None if it cannot be read.
        """
        try:
            return find()
        except (DatasetError, ValueError) as error:
            missing.append(f"{name}: {field} is not shown: {printable(error)}")
            return None

    scans = read_part("the scan", lambda: sample.scans(lidar)) or ()
    masks = {field: read_part(field, partial(getattr, sample, field)) for field in MASKS}
    numbers = read_part("voxel_class", lambda: sample.voxel_class) if classes else None
    return Look(
        name=name,
        grid=grid,
        **pose,
        masks={field: mask for field, mask in masks.items() if mask is not None},
        tudf=read_part("tudf", lambda: sample.tudf),
        scans=[scan.points() for scan in scans],
        rays=sum(scan.ranges.size for scan in scans),
        known=read_part("known", lambda: sample.known),
        scored=read_part("the scored voxels", lambda: scored_voxels(sample, grid, world)),
        fov_deg=field_of_view(scans[0].lidar) if scans else None,
        classes=None if numbers is None else (numbers, classes),
        timeline=read_part("what moves", lambda: _timeline(sample)),
        missing=tuple(missing),
    )


def _timeline(sample: Any) -> Timeline | None:
    """Read what moves in a `Sample`. Raises DatasetError if it is damaged."""
    if sample.mover_kind is None:
        return None
    # compiles: not for those who only show samples
    from scenegen.draw.movers import stored_movers

    movers, times, end_s = stored_movers(sample), sample.scan_times, sample.course_end
    if not np.isfinite([*times, end_s]).all():
        raise DatasetError("scan_times or course_end are not finite; verify the dataset")
    return Timeline(
        movers=movers, scan_times=times, end_s=float(end_s), standing=sample.static_occupancy
    )


Guesses = Callable[[Split, int], Sequence[Guess]]
"""Function that predicts a split's sample, by its index. Raises ScenegenError for a sample that it
cannot predict."""


def look_into(samples: Split, index: int, guesses: Guesses | None) -> Look:
    """Read a sample of a split for display, with its predictions.

    Args:
        samples: The split.
        index: Index of the sample in the split.
        guesses: Function that predicts it, or None.

    Raises:
        IndexError: The split has no such index.
        DatasetError: Nothing of the sample can be shown.
    """
    dataset, name = samples.dataset, f"{samples.name} {index}"
    try:
        home = samples.home(index)
        if home.graded != dataset.kind:  # the title has the kind of the dataset
            name += f", {home.graded}"
        classes = home.parts["labels"].classes if "labels" in home.parts else ()
        sample, world = samples[index], home.tables.world
        look = look_at(sample, dataset.grid, home.lidar, name, world, classes)
    except DatasetError as error:
        raise DatasetError(f"{name} is not shown: {printable(error)}") from None
    if guesses is None:
        return look
    # a sample that a method cannot predict is still worth showing
    try:
        return replace(look, guesses=tuple(guesses(samples, index)))
    except ScenegenError as error:
        line = f"{name}: its prediction is not shown: {printable(error)}"
        return replace(look, missing=(*look.missing, line))


def looks(
    dataset: AnyDataset, split: str, indices: Iterable[int], guesses: Guesses | None = None
) -> tuple[list[Look], list[str]]:
    """Read samples of a split for display, with their predictions.

    Args:
        dataset: The dataset.
        split: Name of the split.
        indices: Indices of the samples in the split.
        guesses: Function that predicts them, or None.

    Returns:
        The samples, and a line for each part that could not be read.

    Raises:
        DatasetError: The split has no such index, or none of the samples can be read.
    """
    samples, readable, notes = dataset.split(split), [], incomplete(dataset, split)
    if notes and not len(samples):
        raise DatasetError(f"{dataset.name}: {notes[0]}")
    for index in indices:
        try:
            readable.append(look_into(samples, index, guesses))
        except IndexError as error:
            raise DatasetError(f"{error}; expected --index below {len(samples)}") from None
        except DatasetError as error:
            notes.append(str(error))
    notes += [line for look in readable for line in look.missing]
    if not readable:
        raise DatasetError(notes[-1] if notes else f"{dataset.name}: its {split} split is empty")
    return readable, notes


def looks_of_dataset(path: Path, count: int = 24) -> list[Look]:
    """Read some samples of a dataset for display.

    Args:
        path: A dataset, a collection or a selection.
        count: Maximum number of samples, evenly spread over the first split that has any.

    Raises:
        DatasetError: There is no dataset, or none of the samples can be read.
    """
    dataset = open_data(path, partial=True)  # an unfinished run has samples to show, too
    split = next((name for name in SPLITS if len(dataset.split(name))), SPLITS[0])
    return looks(dataset, split, evenly(len(dataset.split(split)), count))[0]


def title_of(dataset: AnyDataset) -> str:
    """Return the name of a dataset for titles: its folder, and its kind if that differs."""
    folder, kind = Path(dataset.name).name, dataset.kind
    return printable(folder if folder == kind else f"{folder}: {kind}")


def incomplete(dataset: AnyDataset, split: str) -> list[str]:
    """Warn of an incomplete dataset.

    Args:
        dataset: The dataset.
        split: Name of the split whose samples the warning counts.

    Returns:
        One line, or none for a complete dataset.
    """
    if all(part.manifest.complete for part in dataset.datasets):
        return []
    count = len(dataset.split(split))
    # shards that a killed run finished may be there, but the manifest lists none of them yet
    so_far = f"the dataset is incomplete: its {split} split has {count} samples so far"
    return [so_far if count else INCOMPLETE]


def evenly(count: int, limit: int) -> list[int]:
    """Return evenly spread numbers below `count`.

    Args:
        count: How many numbers there are.
        limit: Maximum of numbers to return.
    """
    return np.unique(np.linspace(0, count - 1, min(limit, count)).astype(int)).tolist()
