"""A trained network as one object: partial maps in, predictions out.

completer = Completer.from_pretrained("proposed")
prediction = completer(sample)  # or its inputs by name
prediction.occupancy_probability, prediction.tudf  # the same shape, float32; metres
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from lidarsim import Lidar
from lidarsim.grid import GridSpec, Mask, finite
from lidarsim.scan import are_returns
from scenegen.base.errors import DatasetError, check_int, needs, printable, reraise_as
from scenegen.base.files import Json, real_path
from scenegen.base.limits import MAX_BATCH
from scenegen.dataset.locate import client_output, file_sha256, without_tokens
from scenegen.dataset.parameters import differences, mapping_entry, sensor_entry
from scenegen.dataset.read import Split
from scenegen.draw.sample import Sample
from scenegen.model.calibration import Calibration
from scenegen.model.checkpoint import CheckpointError, load_network
from scenegen.model.completion.protocol import Prediction, check_prediction
from scenegen.model.config import BUNDLED, DEFAULT_NETWORK, bundled, split_own, unknown_network
from scenegen.model.inputs import BINARY, PointScan, SeenMap, channels
from scenegen.model.network import Batch, Output, placed
from scenegen.model.onnx import load_onnx
from scenegen.model.targets import BUILT_IN, Target, targets_of
from scenegen.worlds.mapping import Mapper, Sensing

HUB = "hf://"
MAX_DIFFERENCE = 300
"""Length at which the description of how two sensors differ is cut, characters."""
TRAINING = "in training", "here"
"""Names of the two sides of a difference: the data of the training, and the input."""
Maps: TypeAlias = NDArray[Any] | Tensor
NAMES_IN_FOLDER = ("best.safetensors", "model.safetensors")
"""Names of a network's file in a run's folder or a repository."""


@dataclass(eq=False, repr=False, kw_only=True)
class Completer:
    """A network with the grid it was trained on: `from_pretrained` opens one, and a call completes
    maps. It is a `MapCompleter`, too, and a row of the bench; one that `from_pretrained` opened
    travels to other processes, each of which opens it once, and by itself."""

    forward: Callable[[Batch], Output]
    """The network itself."""
    grid: GridSpec
    name: str
    """How the network is called in tables, in one line."""
    inputs: tuple[str, ...]
    """Names of the channels that it takes; see `scenegen.model.inputs`."""
    about: Json
    """Metadata of its training: settings, versions, validation figures."""
    batch: int
    """How many maps are completed at once, at most."""
    threads: int
    """Threads of the processor on which it computes; 0 for all."""
    opened: tuple[str, str, int]
    """Name, device and batch, by which `opened_once` has it in other processes."""
    targets: Mapping[str, Target]
    """Its targets, by `target_name`."""
    draws: bool = False
    """Whether its answers are drawn: a network of one's own that says ``draws = True``."""
    learned = True

    def __post_init__(self) -> None:
        self.batch = check_int("batch =", self.batch, 1, MAX_BATCH)
        with reraise_as(CheckpointError, f"{self.name}: "):
            self.calibration = Calibration.of(self.about)
            """Source of calibrated probabilities; None for a network that was not calibrated."""

    @classmethod
    def from_pretrained(
        cls,
        name: str | Path = DEFAULT_NETWORK,
        *,
        device: str | torch.device = "cpu",
        batch: int = 8,
        threads: int = 0,
    ) -> "Completer":
        """Open a network.

        Code of a user's own is imported only if the name grants it, as in "my_net:Net@runs/mine",
        and never because a file says so.

        Args:
            name: A bundled network (`scenegen.model.config.bundled` lists them), a .safetensors
                file, a run's folder, an .onnx file, which runs on the CPU, or
                ``hf://user/name[@revision]``; only the last is downloaded.
            device: The device.
            batch: How many maps are completed at once, at most.
            threads: Threads of the processor; 0: all.

        Returns:
            The network, ready to complete maps.

        Raises:
            CheckpointError: There is no such network, it is damaged, or there is no such device.
        """
        path, (own, plain) = locate(name), split_own(name)
        if path.suffix == ".onnx":
            run, file = load_onnx(path, threads=threads, trusted=own)
            grid, about, inputs = file.grid, file.metadata, file.config.inputs
            draws = False
            targets = {**BUILT_IN, **targets_of(file.config.targets)}
        else:
            network, grid, about = load_network(path, own)
            inputs, targets = network.config.inputs, network.targets
            draws = bool(getattr(network, "draws", False))
            unfit = RuntimeError, AssertionError
            with reraise_as(CheckpointError, f"device {device}: ", "; give cpu", of=unfit):
                placed(network, device)

            def run(maps: Batch) -> Output:
                return Output(*network({name: values.to(device) for name, values in maps.items()}))

        # a file's name may hold control characters, and the title goes to terminals
        title = printable(called(name, path))
        if not (plain.startswith(HUB) or plain in bundled()):
            # another process may have another current folder
            name = "@".join(filter(None, (",".join(sorted(own)), str(path.absolute()))))
        return cls(
            forward=run,
            grid=grid,
            name=title,
            inputs=inputs,
            about=about,
            batch=batch,
            threads=threads,
            opened=(str(name), str(device), batch),
            targets=targets,
            draws=draws,
        )

    def __repr__(self) -> str:
        return f"<Completer: {self.name}, {', '.join(self.inputs)} on {self.grid}>"

    def __call__(
        self,
        maps: Sample | Maps | Mapping[str, Maps],
        *,
        sensor: ArrayLike = (0.0, 0.0, 0.0),
        rng: np.random.Generator | None = None,
    ) -> Prediction:
        """Complete one map, (*grid.shape), or a batch of them, (B, *grid.shape).

        Args:
            maps: A dataset's sample; or a named batch of the network's `inputs`; or the points of a
                scan, (N, 3), metres, in a level frame, NaN or inf where nothing returned; or, for a
                network that takes no more, the observed voxels. Numpy or torch, numbers 0 and 1 or
                bool where an input is binary.
            sensor: Position (3,) of the sensor of a scan, the centre of the map, metres.
            rng: Random numbers of a network that draws; by default, those of seed 0.

        Returns:
            float32 of the map's shape, torch for maps of torch (on the same device) and else numpy;
            distances are metres, at most the truncation. Parts that the network does not predict
            are None.

        Raises:
            ValueError: An input is missing, of another grid, or holds values that it cannot; or no
                point is in the map.
            PredictionError: The network gives NaN, a probability outside [0, 1], or a negative
                distance.
        """
        inputs: Any = maps
        # `observed` is always kept: it tells how unfamiliar a map is, whatever the network takes
        rng = rng or np.random.default_rng(0)
        names = "observed", *self.inputs
        with on_threads(self.threads):
            if getattr(inputs, "ndim", 0) == 2:
                inputs = self.scan_of(inputs, sensor)
            if isinstance(inputs, Sample | PointScan | SeenMap):
                lidar = getattr(inputs, "lidar", None)  # of points nobody knows it
                inputs = channels(names, inputs, self.grid, lidar)
            batch = inputs if isinstance(inputs, Mapping) else {"observed": inputs}
            if missing := [name for name in self.inputs if name not in batch]:
                raise ValueError(
                    f"{self.name} takes {', '.join(self.inputs)}; {', '.join(missing)} is not "
                    f"given: give all of them by name, a sample, or points"
                )
            tensors = {name: self._checked(name, batch[name]) for name in names if name in batch}
            shapes = {tuple(values.shape) for values in tensors.values()}
            if len(shapes) > 1:
                raise ValueError(f"{', '.join(tensors)} have shapes {sorted(shapes)}, expected one")
            (shape,) = shapes
            split = [
                values.reshape(-1, *self.grid.shape).split(self.batch)
                for values in tensors.values()
            ]
            # not all at once: memory is that of `batch` maps, however many there are
            parts = [
                self._complete(dict(zip(tensors, part, strict=True)), rng)
                for part in zip(*split, strict=True)
            ]
            first = batch[self.inputs[0]]

            arrays = dict[str, Any]()
            for name in parts[0]:  # of all maps, as these were given
                whole = torch.cat([part[name] for part in parts])
                whole = whole.reshape(*shape[:-3], *whole.shape[1:])
                arrays[name] = (
                    whole.to(first.device) if isinstance(first, Tensor) else whole.numpy(force=True)
                )
            # a batch given by name may lack it; then nobody knows how unfamiliar its maps are
            seen = tensors.get("observed")
            prediction = Prediction.of(arrays, calibration=self.calibration, observed=seen)
            return check_prediction(prediction, shape, self.name, self.targets)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the network's file."""
        return file_sha256(locate(self.opened[0]))

    def __reduce__(self) -> Any:
        # weights do not travel with every task, and a pool of threads would not survive a fork
        return opened_once, self.opened

    def completion(
        self, sample: Sample, split: Split, rng: np.random.Generator | None = None
    ) -> Prediction:
        """See `scenegen.model.bench.methods.Method`.

        It takes one thread: where many processes complete, each was forked, and a pool of threads
        would not survive.

        Args:
            sample: The sample.
            split: Its split.
            rng: See `__call__`.

        Returns:
            The prediction.

        Raises:
            DatasetError: The grid differs.
        """
        with reraise_as(DatasetError), on_threads(1):
            self.check_grid(split.dataset.grid)
            return self(sample, rng=rng)

    def complete(
        self,
        observed: Mask,
        free: Mask,
        *,
        grid: GridSpec,
        seen: SeenMap | None = None,
        rng: np.random.Generator | None = None,
    ) -> Prediction:
        """See `MapCompleter.complete`.

        Args:
            observed: Voxels that hold a return (*grid.shape).
            free: Voxels that a ray crossed (*grid.shape).
            grid: The grid.
            seen: The same map with its place, from which all inputs are computed.
            rng: See `__call__`.

        Returns:
            The prediction.

        Raises:
            ValueError: The grid differs, or the network takes inputs that only `seen` gives.
        """
        self.check_grid(grid)
        maps: Any = {"observed": observed, "free": free} if seen is None else seen
        return self(maps, rng=rng)

    def check_grid(self, grid: GridSpec) -> None:
        """Check that the network completes maps on a grid.

        Raises:
            ValueError: It does not.
        """
        if grid != self.grid:
            raise ValueError(
                f"the maps are on {grid}, {self.name} completes maps on {self.grid}; train a "
                "network on this grid with `scenegen train`"
            )

    def unlike(self, settings: Iterable[Sensing]) -> list[str]:
        """Describe the sensing of a dataset that the network did not learn from.

        Args:
            settings: The dataset's sensing: sensors, mappings and noise.

        Returns:
            Lines, each once; see the function `unlike`.
        """
        return sorted(
            filter(None, {unlike(self.name, self.about, *sensing) for sensing in settings})
        )

    def scan_of(self, points: Any, sensor: ArrayLike) -> PointScan:
        """Make a scan of points; those that are no returns, see `are_returns`, are dropped.

        Args:
            points: (N, 3), metres.
            sensor: Position (3,), metres.

        Returns:
            The scan, in a map around the sensor.

        Raises:
            ValueError: The points have another shape, or none is in the map.
        """
        rows = np.asarray(points, float)
        if rows.shape[1:] != (3,):
            raise ValueError(f"points of shape {rows.shape}, expected (N, 3), metres")
        position = finite("sensor", sensor, 3)
        returned = rows[are_returns(rows, position)]
        scan = PointScan(points=returned, position=position, grid=self.grid)
        if not len(scan.voxels):
            raise ValueError(
                f"none of {len(rows)} points is in the map ({len(rows) - len(returned)} are no "
                f"returns), {self.grid.extent_m.tolist()} m around the sensor at "
                f"{position.tolist()}; give metres, and where the sensor is"
            )
        return scan

    def _checked(self, name: str, maps: Maps) -> Tensor:
        """An input as a tensor, if it can be one."""
        try:
            tensor = (
                # a copy, for torch takes no arrays that cannot be written to
                maps if isinstance(maps, Tensor) else torch.from_numpy(np.array(maps, order="C"))
            )
        except TypeError:
            message = (
                f"{name} is of type {type(maps).__name__}; expected a sample, or a map as an array"
            )
            raise ValueError(message) from None
        if tensor.shape[-3:] != self.grid.shape or tensor.ndim not in (3, 4):
            raise ValueError(
                f"{name} has shape {tuple(tensor.shape)}, expected {self.grid.shape} or (B, "
                f"*{self.grid.shape}): "
                f"{self.name} completes maps of voxels of {self.grid.voxel_m} m, indexed x, y, z"
            )
        if not tensor.numel():
            raise ValueError(f"{name} holds no map; give at least one")
        if name in BINARY:
            if tensor.dtype != torch.bool and not ((tensor == 0) | (tensor == 1)).all():
                raise ValueError(
                    f"{name} holds values other than 0 and 1; expected a mask of voxels"
                )
        elif not tensor.isfinite().all():
            raise ValueError(f"{name} holds NaN or infinity; expected finite numbers")
        return tensor

    @torch.inference_mode()
    def _complete(self, maps: Batch, rng: np.random.Generator) -> dict[str, Tensor]:
        # a network draws by torch's global generator; the caller's numbers stay as they were
        with torch.random.fork_rng() if self.draws else nullcontext():
            if self.draws:
                torch.manual_seed(int(rng.integers(2**63)))
            return self.forward(maps).predictions(self.targets, self.grid)


@contextmanager
def on_threads(count: int) -> Iterator[None]:
    """Let torch compute on so many threads while the block runs.

    Args:
        count: Number of threads; 0 for as many as before.
    """
    # the number is global to torch, so it is put back for the caller's own networks
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@cache
def opened_once(name: str, device: str, batch: int) -> Completer:
    """Open a network for a task of many, on one thread. Each process opens it once, and by itself.

    Args:
        name: See `Completer.from_pretrained`.
        device: The device.
        batch: How many maps are completed at once, at most.

    Returns:
        The network, the same object on every call.
    """
    with on_threads(1):
        return Completer.from_pretrained(name, device=device, batch=batch, threads=1)


def unlike(name: str, about: Json, lidar: Any, mapping: Mapper, noise: str) -> str:
    """Describe how sensing differs from that which a network learned from.

    Networks of earlier commits name none: they learned from the paper's, without noise.

    Args:
        name: The network's name.
        about: Its origin, see `Completer.about`.
        lidar: The sensor.
        mapping: How maps are made.
        noise: Stages of noise as a manifest spells them.

    Returns:
        One line; "" if nothing differs.
    """
    current, usual = sensor_entry(lidar), mapping_entry(Mapper())

    def describe(way: Json) -> tuple[int, str]:
        """Distance from one sensing that the network learned from, and its description."""
        learned_from, noises = way.get("lidar") or sensor_entry(Lidar()), way.get("noise") or [""]
        sensor, faults = differences(learned_from, current, TRAINING), []
        # tables of rays have nothing else
        if sensor and ("sensor" in learned_from or "sensor" in current):
            sensor = [f"sensor is {_titled(learned_from)} in training, {_titled(current)} here"]
        if noise not in noises:
            learned = " or ".join(stages or "none" for stages in noises)
            faults = [f"noise is {learned} in training, {noise or 'none'} here"]
        maps = differences(
            {"mapping": way.get("mapping") or usual}, {"mapping": mapping_entry(mapping)}, TRAINING
        )
        # a sensor that differs says more than noise, and that more than maps
        if sensor:
            distance, kind = 3, "another sensor"
        elif faults:
            distance, kind = 2, "other noise"
        elif maps:
            distance, kind = 1, "maps made otherwise"
        else:
            return 0, ""
        line = "; ".join(sensor + faults + maps)[:MAX_DIFFERENCE]
        line = f"{name} was trained on {kind}, so expect worse completions: {printable(line)}"
        return distance, line

    # a network may have learned from several sensors and mappings: the nearest is described
    return min(map(describe, (about, *about.get("also", ()))))[1]


def _titled(entry: Json) -> str:
    """Describe the sensor of a manifest's entry in words."""
    rays = " × ".join(map(str, entry.get("shape") or [entry.get("rows"), entry.get("columns")]))
    return f"{entry.get('made_by') or entry.get('sensor', 'a raster')} of {rays} rays"


def called(name: str | Path, path: Path) -> str:
    """Name a network in tables: by its file, its run, or its repository.

    Args:
        name: The network as the user names it.
        path: Its file.

    Returns:
        The name.
    """
    # each run calls its network best.safetensors: the folder tells runs apart
    if (name := split_own(name)[1]).startswith(HUB):
        return name.removeprefix(HUB).partition("@")[0].rpartition("/")[2]
    return real_path(path).parent.name if path.name in NAMES_IN_FOLDER else path.stem


def open_network(name: str | Path) -> tuple[Any, GridSpec, Json]:
    """Open a network by its name, see `Completer.from_pretrained`, for use as a module of torch.

    Args:
        name: The name.

    Returns:
        The network, its grid and its metadata, as `load_network` returns them.
    """
    return load_network(locate(name), split_own(name)[0])


def locate(name: str | Path) -> Path:
    """Find the file of a network, see `Completer.from_pretrained`.

    Only names that begin with ``hf://`` use the internet.

    Args:
        name: The name.

    Returns:
        The file.

    Raises:
        CheckpointError: There is no such network.
    """
    name = split_own(name)[1]
    if name.startswith(HUB):
        return _fetch(name)
    if name in bundled():
        return BUNDLED / f"{name}.safetensors"
    path = Path(name)
    if path.is_dir():
        if files := [path / inside for inside in NAMES_IN_FOLDER if (path / inside).is_file()]:
            return files[0]
        raise CheckpointError(
            f"{path}: a folder without {' or '.join(NAMES_IN_FOLDER)}; give a run's folder or a "
            f"file"
        )
    if path.is_file():
        return path
    hint = (
        f"; a repository on the Hub is {HUB}{name}"
        if re.fullmatch(r"[\w.-]+/[\w.-]+", name)
        else ""
    )
    raise CheckpointError(f"{unknown_network(name)}{hint}")


def _fetch(name: str) -> Path:
    """Download the network of a repository, through the Hub's cache."""
    repository, _, revision = name.removeprefix(HUB).partition("@")
    try:
        from huggingface_hub import hf_hub_download
    except ImportError:
        raise CheckpointError(f"{name}: {needs('huggingface_hub', 'publish')}") from None
    try:
        with client_output(show_progress=False):
            return Path(hf_hub_download(repository, NAMES_IN_FOLDER[1], revision=revision or None))
    except Exception as error:  # its errors share no base
        # addresses in these messages may hold a token
        raise CheckpointError(f"{name}: cannot be fetched: {without_tokens(error)}") from None
