"""Samples for torch: named maps by number, and batches in a seeded order."""

import itertools
import signal
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from fractions import Fraction
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch.utils.data import DataLoader, Dataset

from lidarsim import Sensor
from lidarsim.grid import GridSpec, Ints
from lidarsim.parameters import short_repr
from scenegen.base.errors import DatasetError, ScenegenError
from scenegen.dataset.collection import check_together, open_data
from scenegen.dataset.read import AnyDataset
from scenegen.draw.mixture import fraction
from scenegen.draw.sample import Sample, rng_of
from scenegen.model.config import TrainConfig, target_name
from scenegen.model.inputs import SYMMETRIES, channels, points_of, turned
from scenegen.model.network import Batch
from scenegen.model.targets import BUILT_IN, channels_of, true_map, turned_truth
from scenegen.streams.stream import Batches, Stream
from scenegen.truth import distance_field
from scenegen.worlds.kinds import find_kind, kind_names
from scenegen.worlds.mapping import Mapper, Sensing

LOADERS = 8
"""The order of a stream's batches is made for so many loader processes: if their number divides
this, each flight is drawn by one process only. The order does not depend on their number."""

STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that stop a run."""
SAME_RAY = 1e-6
"""Rays whose unit vectors differ by less count as equal, since directions are rounded."""


class LoaderError(DatasetError):
    """A process that reads samples has died."""


class Samples(Protocol):
    """Numbered samples with named fields, to train on: a split of a dataset, or any object with
    these attributes that can be pickled for loader processes.

    Two attributes are optional. `weight`, if not None, is the share of training samples in
    proportion to the weights of other sources. `parts` holds settings from which targets compute
    their channels, see `parts_of`.
    """

    grid: GridSpec
    lidar: Sensor
    name: str
    """Name of the source, for errors."""
    kind: str
    """Kind of their worlds, for the network's card."""
    digest: str
    """Identity of the samples: a run continues only with the same digest."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> Sample:
        """Return a sample. Only `occupancy`, and fields that inputs and targets read, are used."""
        ...


Key = tuple[int, int]
"""Index of a map, and number of its view: see `views`."""


class SplitSamples:
    """Samples of a dataset's split, see `Samples`. Each process opens the files that it reads.

    Args:
        dataset: One dataset, or several of one collection.
        split: Name of the split.
        weight: See `Samples`.

    Raises:
        DatasetError: if worlds of the dataset are of a kind for testing alone.
    """

    def __init__(self, dataset: AnyDataset, split: str, weight: Any = None):
        for part in dataset.datasets:
            kind = part.manifest.kind
            if kind in kind_names() and not find_kind(kind).for_training:
                raise DatasetError(
                    f"{dataset.name}: holds worlds of kind {kind}, which is for testing alone; "
                    "train on other kinds"
                )
        self.weight = weight
        self.grid, self.lidar, self.name = dataset.grid, dataset.lidar, dataset.name
        self.kind, self.digest = dataset.kind, dataset.digest
        self.settings = dataset.settings
        known = (part.manifest.known for part in dataset.datasets)
        self.known = next((rules for rules in known if rules is not None), None)
        self._split = dataset.split(split)

    def __len__(self) -> int:
        return len(self._split)

    def __getitem__(self, index: int) -> Sample:
        return self._split[index]

    @property
    def parts(self) -> list[Mapping[str, Any]]:
        """Settings of the parts of samples, such as labels, for each dataset."""
        return [part.manifest.parts for part in self._split.dataset.datasets]


def opened(names: Any, split: str) -> list[Samples]:
    """Open one split of several datasets.

    Args:
        names: Names for `open_data`, pairs (name, weight), or a mapping of names to weights, which
            are above 0. Training draws samples in proportion to the weights, whatever the sizes of
            the datasets; without weights, each sample comes once per pass.
        split: Name of the split.

    Returns:
        The samples of each dataset.

    Raises:
        DatasetError: if a dataset is missing or damaged, or if two hold the same samples, or one
            world in different splits.
    """
    if isinstance(names, Mapping):
        names = names.items()
    # of a mapping or of pairs, each entry has a weight; of names, none has
    parts = [entry if isinstance(entry, tuple) else (entry, None) for entry in names]
    datasets = [open_data(name) for name, _ in parts]
    check_together([part for dataset in datasets for part in dataset.datasets])
    return [
        SplitSamples(dataset, split, weight)
        for dataset, (_, weight) in zip(datasets, parts, strict=True)
    ]


class Maps(Dataset):
    """One or more sources of samples, one after the other, as a dataset of torch.

    ``maps[n]`` is a named batch of one map without the batch axis: the inputs, (*grid.shape) each,
    and the truth of occupancy, distances and targets. ``maps[n, v]`` is the same map turned by
    symmetry `v` % 8. From `v` = 8 on, its inputs are computed from points alone, so rays without a
    return free nothing.

    Args:
        sources: The samples.
        split: Name of the split, for errors.
        inputs: Names of inputs.
        targets: Names of targets besides occupancy and distances.

    Raises:
        DatasetError: if there is no source, if two differ in their grid or hold the same samples,
            or if a weight is so small that no map of its source comes in a pass.
        RecipeError: if a weight is not a number above 0.
    """

    def __init__(
        self,
        sources: Sequence[Samples],
        split: str,
        inputs: Sequence[str] = ("observed",),
        targets: Sequence[str] = (),
    ):
        if not sources:
            raise DatasetError("no dataset given; make one with `scenegen generate --kind pillar`")
        check_alike(sources)
        for earlier, source in itertools.combinations(sources, 2):
            if source.digest == earlier.digest:
                raise DatasetError(
                    f"{source.name}: holds the same samples as {earlier.name}; name one of the two"
                )
        self.split = split
        self.sources, self.inputs = tuple(sources), tuple(inputs)
        self.targets = tuple(dict.fromkeys((*BUILT_IN, *targets)))
        self.grid = sources[0].grid
        self.settings = [sensing for source in sources for sensing in settings_of(source)]
        self.partly_known = any(getattr(source, "known", None) is not None for source in sources)
        """Whether some maps are of real places. All then have ``known``, so that they can be
        batched."""
        self.mirrored = all(map(is_mirrored, {sensing.lidar for sensing in self.settings}))
        """Whether the sensors could have seen the mirror image of each map."""
        self.starts = np.cumsum([0, *map(len, sources)])
        """Index of the first map of each source, and the number of all maps."""
        weights = [getattr(source, "weight", None) for source in sources]
        self.shares: list[Fraction] | None = None
        """Weight of each source; None if no source has one."""
        self.counts = [len(source) for source in sources]
        """Number of maps of each source in a pass; their sum is the number of all maps."""
        if any(weight is not None for weight in weights):
            self.shares = [
                fraction(1 if weight is None else weight, source.name, "train")
                for source, weight in zip(sources, weights, strict=True)
            ]
            self.counts = self._counted(self.shares)

    def __len__(self) -> int:
        return int(self.starts[-1])

    def __getitem__(self, key: int | Key) -> Batch:
        index, view = key if isinstance(key, tuple) else (key, 0)
        source, row = self._place(index)
        sample = source[row]
        # samples of a mixture may differ in their sensor
        sensor = getattr(sample, "lidar", None) or source.lidar
        # `points_of` gives None for maps of several scans, which are shown as they are
        seen = sample if view < SYMMETRIES else points_of(sample, source.grid, sensor) or sample
        maps = channels(self.inputs, seen, source.grid, sensor)
        truth = {name: true_map(name, sample, source.grid) for name in self.targets}
        if self.partly_known:
            known = getattr(sample, "known", None)
            maps["known"] = np.ones(source.grid.shape, bool) if known is None else known
            # a distance is certain if no unknown voxel, which may be occupied, is nearer
            maps["certain"] = truth["tudf"] <= distance_field(~maps["known"], source.grid)
        turn = view % SYMMETRIES
        batch = {name: turned(values, turn) for name, values in maps.items()}
        # vectors of a user's own target must turn, too, not only their places
        for name, values in truth.items():
            batch[target_name(name)] = turned_truth(name, values, turn)
        return {name: torch.from_numpy(values) for name, values in batch.items()}

    def channels(self) -> tuple[int, ...]:
        """Return the number of channels of each target besides occupancy and distances.

        Raises:
            DatasetError: if the sources lack the parts that a target needs, or differ in them.
        """
        parts = [settings for source in self.sources for settings in parts_of(source)]
        return tuple(channels_of(name, parts) for name in self.targets[len(BUILT_IN) :])

    def order(self, batch: int) -> Batches | None:
        """Return the batches of a stream.

        Args:
            batch: Maps per batch.

        Returns:
            Batches in the order of the stream; None if the sources are datasets, which are seen in
            passes.

        Raises:
            DatasetError: if there is a stream beside other sources.
        """
        streams = [source for source in self.sources if isinstance(source, Stream)]
        if not streams:
            return None
        if len(self.sources) > 1:
            raise DatasetError(
                f"{streams[0].name}: is trained on alone; mix several into one stream"
            )
        return streams[0].batches(batch, loaders=LOADERS)

    def _counted(self, shares: Sequence[Fraction]) -> list[int]:
        """Divide a pass among the sources in proportion to `shares`, exact to less than one map."""
        # rounding cumulative numbers, not each count, keeps their sum
        ends = [int(len(self) * sum(shares[:n]) / sum(shares)) for n in range(len(shares) + 1)]
        counts = [stop - start for start, stop in itertools.pairwise(ends)]
        for count, source, share in zip(counts, self.sources, shares, strict=True):
            if len(self) and not (count and len(source)):
                raise DatasetError(
                    f"{source.name}: of its {len(source)} samples, weight {short_repr(str(share))} "
                    f"would have {count} come in a pass of {len(self)}, expected one at least of "
                    "each dataset; give other weights"
                )
        return counts

    def name(self, index: int) -> str:
        """Name of a sample for people: source, split, number."""
        source, row = self._place(index)
        return f"{source.name}, {self.split} sample {row}"

    def _place(self, index: int) -> tuple[Samples, int]:
        """Return the source of map `index`, and the number of its sample there."""
        number = int(np.searchsorted(self.starts, index, side="right")) - 1
        return self.sources[number], index - int(self.starts[number])


def settings_of(source: Samples) -> list[Sensing]:
    """Return sensor, mapping and noise of each part of a source.

    By default, samples of a user's own have one scan per map without noise.
    """
    plain = (source.lidar, getattr(source, "mapping", Mapper()), "")
    return [Sensing(*part) for part in getattr(source, "settings", (plain,))]


def parts_of(source: Samples) -> list[Mapping[str, Any]]:
    """Return the settings of samples' parts, such as labels, for each dataset or component of a
    source. Samples of a user's own may have them in `parts`."""
    if isinstance(source, Stream):
        return [component.recipe.parts for component in source.mixture.components]
    return getattr(source, "parts", [{}])


def check_alike(sources: Sequence[Samples]) -> None:
    """Check that all sources have the same grid.

    Args:
        sources: At least one source.

    Raises:
        DatasetError: if two differ.
    """
    first = sources[0]
    for source in sources[1:]:
        if source.grid != first.grid:
            raise DatasetError(
                f"{source.name}: its grid is {source.grid}, that of {first.name} is {first.grid}; "
                f"one network takes one grid: train on datasets that share it"
            )


def is_mirrored(sensor: Sensor) -> bool:
    """Whether the rays of a sensor are mirror-symmetric, left and right of the body.

    Only then could it have seen the mirror image of a map. A turned map needs no such condition:
    the sensor could have been turned, too.
    """
    rays = sensor.directions_body.reshape(-1, 3)
    return bool((KDTree(rays).query(rays * (1, -1, 1))[0] < SAME_RAY).all())


def views(
    maps: Maps, config: TrainConfig, count: int, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Draw views of maps: turned, mirrored if the sensor's rays allow it, or as points alone.

    Args:
        maps: The maps.
        config: Settings of the run, with `augment` and `points_share`.
        count: Number of views.
        rng: Generator, which is advanced.

    Returns:
        (count,): numbers of views, see `Maps`; 0 is the map itself.
    """
    drawn = rng.integers(SYMMETRIES, size=count) if config.augment else np.zeros(count)
    turns = drawn.astype(np.uint8)
    if maps.grid.shape[0] != maps.grid.shape[1]:
        turns = turns // 2 * 2  # a quarter turn would change the shape of the map
    if not maps.mirrored:
        turns = turns % (SYMMETRIES // 2)
    # drawn last, and only if needed, so that runs without it have the same turns
    if config.points_share:
        turns += np.uint8(SYMMETRIES) * (rng.random(count) < config.points_share)
    return turns


def epoch_batches(
    maps: Maps, config: TrainConfig, epoch: int, first: int = 0
) -> Iterator[list[Key]]:
    """Yield the batches of an epoch. The order depends on the seed and the epoch only.

    Args:
        maps: Training maps.
        config: Settings of the run.
        epoch: Number of the epoch, from 0.
        first: Number of batches to skip, for a run that continues within an epoch.

    Yields:
        The keys of `Maps` in each batch. A last batch that is not full is omitted, unless it is the
        only one.
    """
    rng, batch = rng_of(config.seed, epoch), config.batch
    order = rng.permutation(len(maps))
    if maps.shares is not None:
        order = np.concatenate(_weighted(maps, seed=config.seed, epoch=epoch))[order]
    # an epoch may have many millions of maps: five bytes for each, not a tuple of Python numbers
    order = order.astype(np.min_scalar_type(len(maps)))
    turns = views(maps, config, len(order), rng)
    for n in range(first, max(len(order) // batch, 1)):
        rows = slice(n * batch, (n + 1) * batch)
        yield list(zip(order[rows].tolist(), turns[rows].tolist(), strict=True))


def _weighted(maps: Maps, *, seed: int, epoch: int) -> list[Ints]:
    """Return the maps of a pass for each source.

    A source's maps come in a drawn order, which continues in the next pass and is drawn anew when
    it ends. So no map comes twice before all others of the source have come.
    """
    orders = []
    for number, count in enumerate(maps.counts):
        begin, end = epoch * count, (epoch + 1) * count
        size, drawn = len(maps.sources[number]), [np.empty(0, np.int64)]
        for turn in range(begin // size, -(-end // size)):
            # three numbers, so that these draws are independent of those of epochs, which have one
            order = rng_of(seed, number, turn, 0).permutation(size)
            drawn.append(order[max(begin - turn * size, 0) : end - turn * size])
        orders.append(maps.starts[number] + np.concatenate(drawn))
    return orders


def load_batches(
    maps: Maps, batches: Iterable[Sequence[Any]], *, workers: int, pinned: bool
) -> Generator[Batch]:
    """Read batches. Close the generator to end its processes.

    Args:
        maps: The maps.
        batches: Keys of `Maps` for each batch.
        workers: Processes that read; 0 to read in this one.
        pinned: Whether tensors are in pinned memory, from which a copy to a GPU need not wait.

    Yields:
        Named batches, on the CPU.

    Raises:
        DatasetError: if a sample cannot be read.
        GenerationError: if a sample of a stream cannot be drawn.
    """
    loader = DataLoader(maps, batch_sampler=batches, num_workers=workers, pin_memory=pinned)
    # Loader processes inherit the mask. `timeout`, Slurm and systemd signal the whole group; if
    # loaders ended, the training could not finish its step and save its state (docs/log).
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOPS)
    try:
        batches_read = iter(loader)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    try:
        yield from batches_read
    except ScenegenError as error:
        # torch raises the error of a loader process again, with a traceback as its message
        kind, line = type(error), str(error).strip().splitlines()[-1]
        raise kind(line.removeprefix(f"{kind.__module__}.{kind.__name__}: ")) from None
    finally:
        # An error's traceback may keep the iterator alive, and processes that ignore `STOPS` would
        # not end with this one. An iterator without processes has no such method.
        getattr(batches_read, "_shutdown_workers", lambda: None)()


@contextmanager
def loaders_watched() -> Iterator[None]:
    """Turn torch's error for a dead loader process into a `LoaderError`.

    Torch raises a RuntimeError from a signal handler, so it can come anywhere in the training, not
    only in `load_batches`.

    Raises:
        LoaderError: if a process of `load_batches` died.
    """
    try:
        yield
    except RuntimeError as error:
        if "DataLoader worker" not in str(error):
            raise
        raise LoaderError(
            f"a loader process died ({str(error).splitlines()[0]}); give --workers 0, or more "
            f"shared memory"
        ) from None


def collate(samples: Sequence[Sample]) -> dict[str, torch.Tensor]:
    """Make a batch of sparse voxels: a `collate_fn` for MinkowskiEngine, spconv or PyTorch
    Geometric.

    Args:
        samples: Samples with one grid.

    Returns:
        `coordinates` (N, 4) int32: the number of the sample in the batch and the voxel, of all
        observed voxels; `features` (N, 1) float32, ones; the truth, `occupancy` bool and `tudf`
        float32, metres, (B, *grid.shape) each.
    """
    coordinates = np.argwhere(np.stack([sample.observed for sample in samples])).astype(np.int32)
    truth = {
        name: torch.from_numpy(np.stack([getattr(sample, name) for sample in samples]))
        for name in ("occupancy", "tudf")
    }
    ones = torch.ones(len(coordinates), 1)
    return {"coordinates": torch.from_numpy(coordinates), "features": ones, **truth}
