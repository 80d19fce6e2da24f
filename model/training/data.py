"""Samples as torch sees them: named maps by number, and batches in a seeded order."""

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
from scenegen.model.targets import BUILT_IN, channels_of, target_called, true_map
from scenegen.streams.stream import Batches, Stream
from scenegen.truth import distance_field
from scenegen.worlds.mapping import Mapper, Sensing

LOADERS = 8
"""Loader processes, and any number that divides this, among which a stream's batches are dealt so
that each flight is drawn once. The order of batches is the same for any number."""

STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
SAME_RAY = 1e-6
"""How far two rays of one direction may be apart, as unit vectors: what rounding takes."""


class LoaderError(DatasetError):
    """A process that reads samples is gone."""


class Samples(Protocol):
    """What can be trained on: numbered samples with named fields. A split of a dataset is one; so
    is anything else that has these, and travels to processes that read."""

    grid: GridSpec
    lidar: Sensor
    name: str
    """Where the samples are from, for errors."""
    kind: str
    """Kind of their worlds, for the network's card."""
    digest: str
    """What tells these samples from all others: a run with another digest is another run."""

    # where samples have a `weight` that is not None, as those of `opened` may, they come in
    # proportion to it; where they have `parts`, targets find their channels there, see `parts_of`

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> Sample:
        """One sample; only its `occupancy`, and what inputs and targets access, is asked of it."""
        ...


Key = tuple[int, int]
"""A map's index, and which view of it is taken: see `views`."""


class SplitSamples:
    """The samples of a dataset's split. Files are opened in the process that reads them."""

    def __init__(self, dataset: AnyDataset, split: str, weight: Any = None):
        self.weight = weight
        self.grid, self.lidar, self.name = dataset.grid, dataset.lidar, dataset.name
        self.kind, self.digest = dataset.kind, dataset.digest
        self.settings = dataset.settings
        known = (one.manifest.known for one in dataset.datasets)
        self.known = next((one for one in known if one is not None), None)
        self._split = dataset.split(split)

    def __len__(self) -> int:
        return len(self._split)

    def __getitem__(self, index: int) -> Sample:
        return self._split[index]

    @property
    def parts(self) -> list[Mapping[str, Any]]:
        """The settings of the parts of samples of each dataset."""
        return [one.manifest.parts for one in self._split.dataset.datasets]


def opened(names: Any, split: str) -> list[Samples]:
    """The samples of one split of every dataset that is named. Raises DatasetError for a name of
    none, and where two hold the same samples, or a world in two splits.

    `names` is a list of what `open_data` takes, or of pairs (name, weight), or a mapping to
    weights, as a stream's parts are. Weights are numbers above 0, in proportion to which samples
    come in training, however many each dataset holds; without any, each comes once a pass.
    """
    if isinstance(names, Mapping):
        names = names.items()
    parts = [one if isinstance(one, tuple) else (one, None) for one in names]
    datasets = [open_data(name) for name, _ in parts]
    check_together([one for dataset in datasets for one in dataset.datasets])
    return [
        SplitSamples(dataset, split, weight)
        for dataset, (_, weight) in zip(datasets, parts, strict=True)
    ]


class Maps(Dataset):
    """One or more sources of samples, one after the other: ``maps[n]`` holds the `inputs`,
    (*grid.shape) each, and the truth of occupancy, distances and `targets`, by name.

    ``maps[n, v]`` is the same turned by symmetry `v` % 8, and from 8 on shown as points alone, as
    `complete` sees a scan of points. `split` is what the samples are called in
    errors. Raises DatasetError for sources that do not go together.
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
        for other, source in itertools.combinations(sources, 2):
            if source.digest == other.digest:
                raise DatasetError(
                    f"{source.name}: holds the same samples as {other.name}; name one of the two"
                )
        self.split = split
        self.sources, self.inputs = tuple(sources), tuple(inputs)
        self.targets = tuple(dict.fromkeys((*BUILT_IN, *targets)))
        self.grid = sources[0].grid
        self.settings = [one for source in sources for one in settings_of(source)]
        self.partly_known = any(getattr(source, "known", None) is not None for source in sources)
        """Whether some are of maps of real places; then all say what is ``known`` of them."""
        self.mirrored = all(map(is_mirrored, {one.lidar for one in self.settings}))
        """Whether a map's mirror image is one, too, that the sensor could have seen."""
        self.starts = np.cumsum([0, *map(len, sources)])
        """The index of each source's first map."""
        weights = [getattr(source, "weight", None) for source in sources]
        self.shares: list[Fraction] | None = None
        """The weight of each source; None where each of their samples comes once a pass."""
        self.counts = [len(source) for source in sources]
        """How many maps of each come in a pass, which has as many as there are."""
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
        sensor = getattr(sample, "lidar", None) or source.lidar
        seen = sample if view < SYMMETRIES else points_of(sample, source.grid, sensor) or sample
        maps = channels(self.inputs, seen, source.grid, sensor)
        truth = {name: true_map(name, sample, source.grid) for name in self.targets}
        if self.partly_known:
            known = getattr(sample, "known", None)
            maps["known"] = np.ones(source.grid.shape, bool) if known is None else known
            maps["certain"] = truth["tudf"] <= distance_field(~maps["known"], source.grid)
        turn = view % SYMMETRIES
        batch = {name: turned(values, turn) for name, values in maps.items()}
        for name, values in truth.items():
            batch[target_name(name)] = target_called(name).turned(values, turn)
        return {name: torch.from_numpy(values) for name, values in batch.items()}

    def channels(self) -> tuple[int, ...]:
        """How many channels each of the `targets` has that is not built in.

        Raises DatasetError where the sources do not tell, or differ.
        """
        parts = [settings for source in self.sources for settings in parts_of(source)]
        return tuple(channels_of(name, parts) for name in self.targets[len(BUILT_IN) :])

    def order(self, batch: int) -> Batches | None:
        """The batches of a stream, whose maps come in its own order; None for datasets, which are
        seen in passes.

        Raises DatasetError for a stream beside other sources.
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
        """Maps of each source in a pass, where they come in proportion to `shares`, but for less
        than one map."""
        upto = [int(len(self) * sum(shares[:n]) / sum(shares)) for n in range(len(shares) + 1)]
        counts = [stop - start for start, stop in itertools.pairwise(upto)]
        for count, source, share in zip(counts, self.sources, shares, strict=True):
            if len(self) and not (count and len(source)):
                raise DatasetError(
                    f"{source.name}: of its {len(source)} samples, weight {short_repr(str(share))} "
                    f"would have {count} come in a pass of {len(self)}, expected one at least of "
                    "each dataset; give other weights"
                )
        return counts

    def name(self, index: int) -> str:
        """Who sample `index` is, for people: source, split, number."""
        source, row = self._place(index)
        return f"{source.name}, {self.split} sample {row}"

    def _place(self, index: int) -> tuple[Samples, int]:
        number = int(np.searchsorted(self.starts, index, side="right")) - 1
        return self.sources[number], index - int(self.starts[number])


def settings_of(source: Samples) -> list[Sensing]:
    """How the samples of every part of a source were sensed: those of a user's own by their sensor,
    in one scan a map, without noise."""
    plain = (source.lidar, getattr(source, "mapping", Mapper()), "")
    return [Sensing(*one) for one in getattr(source, "settings", (plain,))]


def parts_of(source: Samples) -> list[Mapping[str, Any]]:
    """The settings of the parts of samples, such as labels, of every part of a source; a user's own
    has `parts`, a list of them, or none."""
    if isinstance(source, Stream):
        return [component.recipe.parts for component in source.mixture.components]
    return getattr(source, "parts", [{}])


def check_alike(sources: Sequence[Samples]) -> None:
    """Raise DatasetError unless all `sources` have one grid."""
    first = sources[0]
    for source in sources[1:]:
        if source.grid != first.grid:
            raise DatasetError(
                f"{source.name}: its grid is {source.grid}, that of {first.name} is {first.grid}; "
                f"one network takes one grid: train on datasets that share it"
            )


def is_mirrored(sensor: Sensor) -> bool:
    """Whether the rays of `sensor` are their own mirror image, left and right of the body.

    Any sensor that is turned about the vertical sees what is turned; of what is mirrored, only such
    a one sees the mirror image.
    """
    rays = sensor.directions_body.reshape(-1, 3)
    return bool((KDTree(rays).query(rays * (1, -1, 1))[0] < SAME_RAY).all())


def views(
    maps: Maps, config: TrainConfig, count: int, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """How each of `count` maps is shown in training, drawn: turned, and mirrored where the sensor's
    rays allow it, or as points alone, as `config` says; 0 is the map as it is."""
    drawn = rng.integers(SYMMETRIES, size=count) if config.augment else np.zeros(count)
    turns = drawn.astype(np.uint8)
    if maps.grid.shape[0] != maps.grid.shape[1]:
        turns = turns // 2 * 2  # no quarter turns of a map that is longer than wide
    if not maps.mirrored:
        turns = turns % (SYMMETRIES // 2)
    if config.points_share:  # drawn last, so that the turns of other runs stay
        turns += np.uint8(SYMMETRIES) * (rng.random(count) < config.points_share)
    return turns


def epoch_batches(
    maps: Maps, config: TrainConfig, epoch: int, first: int = 0
) -> Iterator[list[Key]]:
    """The batches of a training epoch, from the `first` on: keys of `Maps`, in an order that
    depends on the seed and `epoch` alone. Meanwhile, a map takes five bytes.

    A last batch that is not full is left out, unless it is the only one.
    """
    rng, batch = rng_of(config.seed, epoch), config.batch
    order = rng.permutation(len(maps))
    if maps.shares is not None:
        order = np.concatenate(_weighted(maps, seed=config.seed, epoch=epoch))[order]
    order = order.astype(np.min_scalar_type(len(maps)))
    turns = views(maps, config, len(order), rng)
    for n in range(first, max(len(order) // batch, 1)):
        rows = slice(n * batch, (n + 1) * batch)
        yield list(zip(order[rows].tolist(), turns[rows].tolist(), strict=True))


def _weighted(maps: Maps, *, seed: int, epoch: int) -> list[Ints]:
    """The maps of a pass by source. Each source's come in an order of its own, which goes on from
    pass to pass and is drawn anew when it ends, so that none comes twice before all others of the
    source have come."""
    orders = []
    for number, count in enumerate(maps.counts):
        begin, end = epoch * count, (epoch + 1) * count
        size, drawn = len(maps.sources[number]), [np.empty(0, np.int64)]
        for turn in range(begin // size, -(-end // size)):
            order = rng_of(seed, number, turn, 0).permutation(size)
            drawn.append(order[max(begin - turn * size, 0) : end - turn * size])
        orders.append(maps.starts[number] + np.concatenate(drawn))
    return orders


def load(
    maps: Maps, batches: Iterable[Sequence[Any]], *, workers: int, pinned: bool
) -> Generator[Batch]:
    """Every batch in turn, read by `workers` processes; 0 for none. Raises DatasetError for what
    cannot be read, GenerationError for what cannot be drawn."""
    loader = DataLoader(maps, batch_sampler=batches, num_workers=workers, pin_memory=pinned)
    # loaders inherit this, and leave stops to the process that trains: what signals its group
    # would end them, too, and with them the step that is being made
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOPS)
    try:
        batches_read = iter(loader)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    try:
        yield from batches_read
    except ScenegenError as error:  # a loader process hands over its traceback with it
        kind, line = type(error), str(error).strip().splitlines()[-1]
        raise kind(line.removeprefix(f"{kind.__module__}.{kind.__name__}: ")) from None
    finally:
        # a traceback that holds them would keep this process from ending
        getattr(batches_read, "_shutdown_workers", lambda: None)()


@contextmanager
def loaders_watched() -> Iterator[None]:
    """Raise LoaderError where a process of `load` dies: torch tells of it by a RuntimeError,
    wherever the process that trains is then."""
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
    """Samples as one batch of sparse voxels: the `collate_fn` of a loader for MinkowskiEngine,
    spconv or PyTorch Geometric.

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
